"""What a class or function does, as text: its source without docstrings, comments and layout.

Two sources with one syntax compile to the same code, so a digest of the syntax changes with an
equation and not with the words about it. Host only.
"""

import ast
import inspect
import textwrap
from typing import Any


def without_docstrings(source: str) -> str:
    """Python `source` parsed and written again, without strings that stand alone as statements
    (docstrings, and those below a field).

    **Raises:** `SyntaxError` for a source that is no whole statement.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        for block in ("body", "orelse", "finalbody"):
            statements = getattr(node, block, None)
            if isinstance(statements, list):
                setattr(node, block, [s for s in statements if not _is_text(s)])
    return ast.unparse(tree)


def syntax_of(thing: Any) -> str:
    """The syntax of a class, function or module; of a lambda, that of all lambdas on its line.

    **Raises:** `OSError` or `TypeError` where Python knows no source: built in, or typed at a
    prompt.
    """
    source = textwrap.dedent(inspect.getsource(thing))
    try:
        if getattr(thing, "__name__", "") == "<lambda>":
            return _lambdas(thing)
        return without_docstrings(source)
    except SyntaxError:  # a string that starts left of the indentation, say
        return source


def _lambdas(function: Any) -> str:
    """The source lines of a lambda are those of the statement around it; its file is parsed to find
    the lambda alone."""
    lines, _ = inspect.findsource(function)
    line = function.__code__.co_firstlineno
    found = [
        node
        for node in ast.walk(ast.parse("".join(lines)))
        if isinstance(node, ast.Lambda) and node.lineno == line
    ]
    return "\n".join(map(ast.unparse, found))


def _is_text(statement: ast.stmt) -> bool:
    value = statement.value if isinstance(statement, ast.Expr) else None
    return isinstance(value, ast.Constant) and isinstance(value.value, str)
