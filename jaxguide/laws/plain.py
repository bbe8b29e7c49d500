"""Plain functions in the place of a contract that needs no memory: each is wrapped once, so that a
flight meets contracts alone."""

import inspect
from typing import Any

import equinox as eqx


class Plain(eqx.Module):
    """A function, or a module that is called like one, in the place of a contract.

    Attributes of the function are found through it: a dispersion of "sensor.noise" means the field
    `noise` of the user's own sensor.
    """

    function: Any

    def __getattr__(self, name: str) -> Any:
        # Python looks here for what is not found: without this, a copy would look for ever.
        if name == "function" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.function, name)


def unwrapped(node: Any) -> Any:
    """The user's own function where `node` wraps one."""
    return node.function if isinstance(node, Plain) else node


def fulfilled(
    value: Any, contract: type, wrapper: type | None, role: str, arguments: tuple[str, ...] = ()
) -> Any:
    """`value` as the `contract` that the mission's `role` needs: itself if it is one, or a function
    of `arguments` within `wrapper` (None: no function will do).

    **Raises:** `ValueError` saying what is wanted, for a class in place of its instance, anything
    that cannot be called, and a function of other arguments.
    """
    if value is None or isinstance(value, contract):
        return value
    name = contract.__name__
    if isinstance(value, type):
        raise ValueError(
            f"Mission: {role} is the class {value.__name__}; give an instance: {value.__name__}()."
        )
    call = f"{role}({', '.join(arguments)})"
    if wrapper is None or not callable(value):
        function = "" if wrapper is None else f", or a function {call}"
        raise ValueError(
            f"Mission: {role} is {value!r}; give an instance of a class derived from "
            f"jg.{name}{function}."
        )
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):  # some compiled functions show none
        return wrapper(value)
    try:
        signature.bind(*arguments)
    except TypeError:
        raise ValueError(
            f"Mission: {role} takes {signature}, but is called as {call}; give a function of these "
            f"arguments, or derive a class from jg.{name}, which may have memory."
        ) from None
    return wrapper(value)
