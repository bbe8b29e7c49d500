"""Checks of an installation: versions, devices, precision, cache, and a known fault of JAX.

Host only, and imports nothing of jaxguide but its cache, which is files: it must run when the rest
does not.
"""

import importlib.metadata
import os
import platform
from typing import Any

import numpy as np

from jaxguide.host import cache as programs

FAULTY_JAX = ("0.10.2",)  # jax issue 39103
PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax", "optax", "numpy")
# By experiment on jax 0.10.2: the fault begins at 16,385 rows (float64) and 32,769 rows (float32),
# but comes and goes with the row count (0 bad rows at 100,000 x 6), so several are checked.
CANARY_ROWS = (16_384, 16_385, 20_000, 32_769, 50_000)
CANARY_COLUMNS = (3, 6)


def canary() -> int:
    """Number of wrong rows in jitted mat-vecs followed by a reduction, vmapped over many rows.

    Some JAX releases return wrong numbers here without any error. Checked against NumPy in
    float32, and in float64 if it is enabled.

    **Returns:** 0 on a sound JAX.
    """
    import jax
    import jax.numpy as jnp

    dtypes = [np.float32] + ([np.float64] if _x64() else [])
    wrong = 0
    for dtype in dtypes:
        for d in CANARY_COLUMNS:
            m = jnp.eye(d, dtype=dtype)
            f = jax.jit(jax.vmap(lambda r, m=m: jnp.sum((m @ r) ** 2)))
            for rows in CANARY_ROWS:
                x = np.zeros((rows, d), dtype)
                x[:, 0] = np.arange(rows)
                want = np.sum(x.astype(float) ** 2, axis=1)
                got = np.asarray(f(jnp.asarray(x)), float)
                # A sum of squares without cancellation: a few eps, 1e-6 is 8 eps of float32.
                # Negated, so that NaN counts as wrong.
                wrong += int(np.sum(~(np.abs(got - want) <= 1e-6 * want)))
    return wrong


def check_installation() -> dict[str, dict[str, Any]]:
    """Every check by name: `{"value": ..., "ok": bool, "remedy": str}`.

    `remedy` is empty where `ok` holds.
    """
    return {**_versions(), **_numbers(), **_environment()}


def _check(value: Any, ok: bool, remedy: str) -> dict[str, Any]:
    return {"value": value, "ok": bool(ok), "remedy": "" if ok else remedy}


def _versions() -> dict[str, dict[str, Any]]:
    """Python and the packages, against the ranges that jaxguide asks for."""
    wanted, python = _requirements(), platform.python_version()
    fits = _meets(python, wanted["python"])
    checks = {"python": _check(python, fits, f"use Python {wanted['python']}")}
    for name in PACKAGES:
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            version = None
        needed = wanted.get(name, "")
        ok = version is not None and _meets(version, needed)
        checks[name] = _check(version, ok, f"pip install '{name}{needed}'")
    return checks


def _numbers() -> dict[str, dict[str, Any]]:
    """Whether this JAX computes right numbers."""
    import jax

    wrong = canary()
    return {
        "faulty jax": _check(
            jax.__version__,
            jax.__version__ not in FAULTY_JAX,
            "this release gives wrong numbers on CPU (jax issue 39103): pip install 'jax!=0.10.2'",
        ),
        "canary": _check(
            f"{wrong} wrong rows",
            wrong == 0,
            "this JAX gives wrong numbers for batched mat-vecs: install another release of jax",
        ),
    }


def _environment() -> dict[str, dict[str, Any]]:
    """Devices, precision, the compilation cache, and the number of cores."""
    import jax

    cache = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    own = programs.state()
    return {
        "devices": _check(
            [f"{d.platform}:{d.id} {d.device_kind}" for d in jax.devices()],
            len(jax.devices()) > 0,
            "no device found: see the installation notes of JAX for your accelerator",
        ),
        "x64": _check(
            _x64(),
            _x64(),
            "nominal solves need float64: jax.config.update('jax_enable_x64', True), "
            "or set JAX_ENABLE_X64=1",
        ),
        "programs kept": _check(
            f"{own.folder}: {own.entries} entries, {own.size / 1e6:.1f} MB" if own.folder else None,
            not own.trouble and (own.folder is None or _writable(str(own.folder))),
            f"every process compiles anew: {own.trouble or 'its folder cannot be written'}; remove "
            f"it, or set {programs.VARIABLE} to a folder of your own (mode 0700)",
        ),
        "compilation cache": _check(
            cache,
            cache is None or _writable(cache),
            "JAX cannot keep programs: set JAX_COMPILATION_CACHE_DIR to a folder you may write",
        ),
        "cores": _check(os.cpu_count(), True, ""),
    }


def _x64() -> bool:
    import jax

    return bool(jax.config.jax_enable_x64)  # pyright: ignore[reportAttributeAccessIssue]


def _requirements() -> dict[str, str]:
    """Version ranges that the installed package asks for; none when it is not installed."""
    try:
        python = importlib.metadata.metadata("jaxguide")["Requires-Python"]
    except importlib.metadata.PackageNotFoundError:
        return {"python": ""}
    from packaging.requirements import Requirement

    wanted = {"python": python}
    for line in importlib.metadata.requires("jaxguide") or ():
        requirement = Requirement(line)
        if requirement.marker is None:
            wanted[requirement.name] = str(requirement.specifier)
    return wanted


def _meets(version: str, specifier: str) -> bool:
    from packaging.specifiers import SpecifierSet

    return SpecifierSet(specifier).contains(version, prereleases=True)


def _writable(folder: str) -> bool:
    """A cache folder may be remote (`gs://...`), or absent until the first compilation."""
    if "://" in folder:
        return True
    folder = os.path.abspath(folder)
    while not os.path.exists(folder):
        folder = os.path.dirname(folder)
    return os.path.isdir(folder) and os.access(folder, os.W_OK)
