"""The memory of this machine: how much there is; what compilation left, given back. Host only."""

import ctypes
import math
import os


def trim() -> None:
    """Returns freed memory to the system, if the C library can (glibc).

    XLA's compiler leaves some 400 MB of it after a nominal, its gains and a tile (by experiment on
    Earth-Mars), which would count as memory of the sweep.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        pass


def physical_memory() -> float:
    """Bytes of this machine; infinite where the system does not say."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE")) * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return math.inf
