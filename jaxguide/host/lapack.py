"""LAPACK kept in one thread. Host only."""

import contextlib
import functools
import importlib
import os
from collections.abc import Iterator

import threadpoolctl

_THREAD_COUNTS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


@functools.cache
def single_threaded_lapack() -> None:
    """From here on SciPy's LAPACK, which XLA calls on CPU, works in the calling thread alone.

    Its own threads spin while they wait: beside any other busy process a direct solve of 50 ms
    took 15 s. NumPy's library stays as it is, where it is another; so does everything if one of
    `OPENBLAS_NUM_THREADS`, `MKL_NUM_THREADS`, `OMP_NUM_THREADS` says how many to use. Host only.
    """
    if _threads_are_given():
        return
    importlib.import_module("scipy.linalg.cython_lapack")
    blas = threadpoolctl.ThreadpoolController().select(user_api="blas")
    for library in blas.lib_controllers:
        if len(blas.lib_controllers) == 1 or "numpy" not in str(library.filepath):
            library.set_num_threads(1)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Inside the block NumPy's and SciPy's algebra works in one thread: its matrices are small. As
    above, unless the environment says how many to use."""
    if _threads_are_given():
        yield
        return
    with _libraries().limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _libraries() -> threadpoolctl.ThreadpoolController:
    importlib.import_module("scipy.linalg.cython_lapack")
    return threadpoolctl.ThreadpoolController()


def _threads_are_given() -> bool:
    return any(name in os.environ for name in _THREAD_COUNTS)
