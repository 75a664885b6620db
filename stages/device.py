"""Where tensors are computed. Not a setting: it must not enter any key, so that a result is valid on any machine."""


def compute_device() -> str:
    """ "cuda" where torch can use a GPU, else "cpu"; set CUDA_VISIBLE_DEVICES to nothing to stay on the CPU."""
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"
