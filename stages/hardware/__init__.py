"""The machine: CPU or GPU, memory, the backend of the kernels."""
