"""Results kept beside the objects they belong to."""

import functools
import weakref
from collections.abc import Callable
from typing import Any


def remembered(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`function` of one object that never changes, such as a Problem; its result is kept as long as
    the object lives. The result must not hold the object, which would then live for ever."""
    kept: dict[int, tuple[weakref.ref, Any]] = {}

    @functools.wraps(function)
    def called(of: Any) -> Any:
        key = id(of)
        found = kept.get(key)
        if found is not None and found[0]() is of:
            return found[1]
        value = function(of)
        kept[key] = weakref.ref(of, lambda _: kept.pop(key, None)), value
        return value

    return called
