"""How work runs: chunks on threads, the profiler, random numbers, precision and rates of the machine."""
