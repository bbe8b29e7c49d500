"""Memory that compilation leaves behind, given back. Host only."""

import ctypes


def trim() -> None:
    """Hands freed memory back to the system, where the C library can (glibc): XLA's compiler leaves
    some 400 MB of it after a nominal, its gains and a tile, which many flights need not carry."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        pass
