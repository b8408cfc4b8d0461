"""Memory for large results on a CPU."""

import mmap

import torch

LARGE = 2**25  # bytes from which the C library asks the system for fresh memory at every call


def empty(shape: torch.Size, *, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """torch.empty; what is large on a CPU lies in large pages where the system has them.

    To hand out fresh memory by 4 KiB takes a processor several times as long as to fill it.
    """
    size = shape.numel() * dtype.itemsize
    if device.type != "cpu" or size < LARGE or not hasattr(mmap, "MADV_HUGEPAGE"):
        return torch.empty(shape, dtype=dtype, device=device)
    pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    try:
        pages.madvise(mmap.MADV_HUGEPAGE)
    except OSError:  # a kernel without large pages
        return torch.empty(shape, dtype=dtype, device=device)
    return torch.frombuffer(pages, dtype=dtype).view(shape)
