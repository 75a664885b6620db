"""Which kernels compute the hash-grid field: Warp's where they run, else torch's; these stay with what they trained."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Literal

from stages.contract import Progress, StageError

if TYPE_CHECKING:
    from nerf.kernels import Backend

BackendName = Literal["warp", "torch"]


def chosen_backend(device: str, progress: Progress | None = None) -> BackendName:
    """ "warp" if its kernels run on ``device`` ("cpu" or "cuda"), else "torch"; then the reason is said."""
    why = why_not_warp(device)
    if why and progress:
        progress.note("hardware.torch-alone", f"the hash-grid field runs on torch alone, several times slower: {why}")
    return "torch" if why else "warp"


def backend_of_field(trained_with: BackendName, device: str, progress: Progress | None = None) -> BackendName:
    """For a field that is trained: torch stays, for who asked for it may have fled from Warp, and is said; one that
    Warp trained is free to take :func:`chosen_backend`."""
    if trained_with == "warp":
        return chosen_backend(device, progress)
    if progress:
        progress.note(
            "hardware.trained-without-warp",
            "the hash-grid field runs on torch alone, as it was trained, several times slower than on Warp",
        )
    return "torch"


def backend_name(backend: "Backend") -> BackendName:
    """What :func:`load_backend` calls it."""
    from nerf.kernels import torch as reference

    return "torch" if backend is reference else "warp"


def load_backend(name: BackendName, device: str, progress: Progress | None = None) -> "Backend":
    """The kernels, compiled for this machine; the first time takes some seconds, of which ``progress`` tells.

    Raises:
        StageError: if Warp's kernels are asked for and do not run on ``device``, or cannot be kept on its disk.
    """
    if name == "torch":
        from nerf.kernels import torch as reference

        return reference
    if why := why_not_warp(device):
        raise StageError("hardware.no-warp", "cannot use the Warp kernels", why, "Use --train.grid.backend torch.")
    from nerf.kernels import warp as kernels

    if progress:
        progress.update("compiling kernels, once on each machine")
    try:
        kernels.compile_kernels(device)
    except OSError as error:
        raise StageError(
            "hardware.kernel-cache",
            "cannot use the Warp kernels",
            _not_kept(error),
            "Or use --train.grid.backend torch.",
        ) from error
    return kernels


def why_not_warp(device: str) -> str | None:
    """What keeps Warp's kernels from running on ``device`` ("cpu" or "cuda"), None if nothing does."""
    try:
        with _without_native_stderr():
            from nerf.kernels import warp as kernels
    except (ImportError, OSError) as error:
        if isinstance(error, OSError) and error.filename is not None:  # a library that does not load names none
            return _not_kept(error)
        return f"warp-lang cannot be loaded: {error}"
    return kernels.unavailable_reason(device)


def _not_kept(error: OSError) -> str:
    """Without a home that can be written to, compiled kernels have no place."""
    return f"the kernel cache cannot be written ({error}); set WARP_CACHE_PATH to another folder"


@contextlib.contextmanager
def _without_native_stderr() -> Iterator[None]:
    """Warp's library prints a warning where there is no GPU, which nobody asked for, and offers no switch."""
    if "nerf.kernels.warp" in sys.modules:
        yield
        return
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
