"""The run-time shape checks of the tests: jaxtyping's shapes by beartype, with an int accepted where a float is asked
for (as in Python's typing rules).

jaxtyping's own decorator compiles two functions wherever a function is defined, a function inside a function thus at
each call of the outer one, and looks at every argument twice. :func:`jaxtyped` asks the same of arguments and results;
it makes its checks at the first call and keeps them by the code of the function. :func:`install` puts it in place.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import types
import typing
from collections.abc import Callable, Sequence

import jaxtyping
from beartype import BeartypeConf, beartype
from beartype.door import die_if_unbearable, is_bearable

_RULES = BeartypeConf(is_pep484_tower=True, violation_type=jaxtyping.TypeCheckError)
checked = beartype(conf=_RULES)

_OF_JAXTYPING = jaxtyping.jaxtyped
_NAMES_OF_AXES = _OF_JAXTYPING("context")
"""Inside, an axis has the same length wherever its name stands; entered anew for each call."""

CHECKS: dict[int, tuple[types.CodeType, Callable]] = {}
"""For each function within a function that was called: its code, which stays so that its ``id`` does, and its maker of
checking functions. Codes are told apart by ``id``, since those of two dataclasses with fields of the same names are
equal.
"""


def install(modules: Sequence[str]) -> None:
    """From now on, whatever is imported of these modules checks its shapes at each call."""
    jaxtyping.install_import_hook(modules, "shape_checks.checked")
    jaxtyping.jaxtyped = jaxtyped  # the name by which the hook decorates


def jaxtyped(*, typechecker: Callable) -> Callable:
    """The decorator of jaxtyping's import hook; ``typechecker`` is always :data:`checked`."""
    return _decorated


def _decorated(thing: Callable) -> Callable:
    """A function that checks what it is given and gives, or a class whose ``__init__`` does if a dataclass made it."""
    if isinstance(thing, type):
        made = vars(thing).get("__init__")
        if dataclasses.is_dataclass(thing) and made is not None and not hasattr(made, "__wrapped__"):
            thing.__init__ = _decorated(made)  # type: ignore[misc]
        return thing
    if not thing.__annotations__:
        return thing
    if any("{" in str(annotation) for annotation in thing.__annotations__.values()):
        return _OF_JAXTYPING(thing, typechecker=checked)  # a shape that is told by an argument: "{self.height}"
    configuration = jaxtyping.config
    call: Callable | None = None

    @functools.wraps(thing)
    def called(*arguments, **named):
        nonlocal call
        __tracebackhide__ = True
        if configuration.jaxtyping_disable:
            return thing(*arguments, **named)
        call = call or _checking(thing)
        return call(*arguments, **named)

    return called


def _checking(function: types.FunctionType) -> Callable:
    """The function with its arguments and its result checked."""
    if "<locals>" in function.__qualname__ or inspect.isgeneratorfunction(function):
        code = function.__code__
        if id(code) not in CHECKS:
            CHECKS[id(code)] = code, _by_signature(inspect.signature(function), _hints(function))
        return CHECKS[id(code)][1](function)
    twin = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    twin.__kwdefaults__ = function.__kwdefaults__
    twin.__qualname__, twin.__module__ = function.__qualname__, function.__module__
    twin.__annotations__ = _hints(function)
    return _with_axes(checked(twin), twin.__annotations__)


def _with_axes(checking: Callable, hints: dict[str, object]) -> Callable:
    """Names of axes hold within one call, if there are any."""
    if "jaxtyping." not in repr(hints):
        return checking

    def call(*arguments, **named):
        __tracebackhide__ = True
        with _NAMES_OF_AXES:
            return checking(*arguments, **named)

    return call


def _by_signature(signature: inspect.Signature, hints: dict[str, object]) -> Callable[[Callable], Callable]:
    """The same for functions that come into being again and again, with other closures, and for generators: a maker of
    checking functions.
    """
    hints = {name: hint for name, hint in hints.items() if not _of_anything(hint)}
    of_result = hints.pop("return", typing.Any)
    kinds = {name: parameter.kind for name, parameter in signature.parameters.items()}
    several = {inspect.Parameter.VAR_POSITIONAL: tuple, inspect.Parameter.VAR_KEYWORD: dict.values}

    def made(function: Callable) -> Callable:
        def call(*arguments, **named):
            __tracebackhide__ = True
            for name, value in signature.bind(*arguments, **named).arguments.items():
                if name in hints:
                    for one in several[kinds[name]](value) if kinds[name] in several else (value,):
                        _check(one, hints[name], function, f"argument {name}")
            result = function(*arguments, **named)
            _check(result, of_result, function, "result")
            return result

        return _with_axes(call, hints | {"return": of_result})

    return made


def _check(value: object, hint: object, function: Callable, which: str) -> None:
    if not is_bearable(value, hint, conf=_RULES):
        die_if_unbearable(value, hint, conf=_RULES, exception_prefix=f"{function.__qualname__}: {which} ")


def _hints(function: types.FunctionType) -> dict[str, object]:
    """The types of arguments and result; anything where an annotation names what only a type checker imports."""
    return {name: _resolved(given, function.__globals__) for name, given in function.__annotations__.items()}


def _resolved(annotation: object, names: dict[str, object]) -> object:
    def holder(value: annotation):  # type: ignore[valid-type]
        del value

    holder.__annotations__["value"] = annotation
    try:
        return typing.get_type_hints(holder, names, include_extras=True)["value"]
    except Exception:
        return typing.Any


def _of_anything(hint: object) -> bool:
    """Whether a type asks for nothing that could be looked at, as the arguments that a wrapper hands through."""
    return isinstance(hint, typing.ParamSpecArgs | typing.ParamSpecKwargs)
