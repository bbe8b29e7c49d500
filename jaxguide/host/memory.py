"""Memory that compilation leaves unused, returned to the system. Host only."""

import ctypes


def trim() -> None:
    """Returns freed memory to the system, if the C library can (glibc).

    XLA's compiler leaves some 400 MB of it after a nominal, its gains and a tile (by experiment on
    Earth-Mars), which would count as memory of the sweep.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        pass
