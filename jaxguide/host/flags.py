"""XLA's options that make flights fast, and those that decide their bits. Host only. JAX reads them
when it starts, so this module must not import it."""

import os

# Loops fused with several outputs, and a flight's loop over samples compiled together with the
# operations around it: twice the flights a second on a CPU (by experiment on Earth-Mars). They can
# be set for a whole process only.
FLIGHTS = (
    "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion,"
    "xla_cpu_small_while_loop_byte_threshold=100000000"
)
_OWN = "--xla_force_host_platform_device_count"  # decides no bit


def set_for_flights() -> None:
    """Sets the options `FLIGHTS`, unless the environment has backend options already. To be called
    before JAX starts."""
    given = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in given:
        os.environ["XLA_FLAGS"] = f"{given} {FLIGHTS}".strip()


def deciding() -> str:
    """The options of this process that may change a rounding."""
    given = os.environ.get("XLA_FLAGS", "").split()
    return " ".join(sorted(flag for flag in given if not flag.startswith(_OWN)))


def take(options: str) -> None:
    """Sets the `deciding` options of another process in this one. To be called before JAX
    starts."""
    own = [flag for flag in os.environ.get("XLA_FLAGS", "").split() if flag.startswith(_OWN)]
    os.environ["XLA_FLAGS"] = " ".join([options, *own]).strip()
