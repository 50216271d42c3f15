"""Finding patterns in expressions and replacing them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from cleargs.models.convert.expression import Expression

Pattern: TypeAlias = str | float | tuple["Pattern", ...]
"""A name binds any expression (the same one, or an equal constant, at every place), a number matches that
constant, and a tuple an operator with its inputs, between which reshapes do not matter; ``Add``, ``Mul`` and
``Max`` match in either order."""

Bindings: TypeAlias = dict[str, Expression]

Rule: TypeAlias = Callable[[Expression], Expression | None]
"""The replacement of an expression, of the same shape; None where the rule does not apply."""

_COMMUTATIVE = ("Add", "Mul", "Max")


def match(pattern: Pattern, x: Expression) -> Bindings | None:
    """What the names of the pattern stand for in ``x``; None if it does not match."""
    return next(_matches(pattern, x, {}), None)


def _matches(pattern: Pattern, x: Expression, bound: Bindings) -> Iterator[Bindings]:
    if isinstance(pattern, str):
        if pattern not in bound or _same(bound[pattern], x):
            yield bound | {pattern: x}
    elif isinstance(pattern, tuple):
        op, *inputs = pattern
        while x.op == "Reshape" and op != "Reshape":
            x = x.inputs[0]
        if x.op == op:
            yield from _match_all(inputs, x.inputs, bound)
            if op in _COMMUTATIVE:
                yield from _match_all(inputs, x.inputs[::-1], bound)
    elif x.value is not None and x.value.size == 1 and abs(x.value.item() - pattern) <= 1e-6 * abs(pattern):
        yield bound


def _match_all(
    patterns: Sequence[Pattern], inputs: Sequence[Expression], bound: Bindings
) -> Iterator[Bindings]:
    if not patterns:
        yield bound
    elif inputs:
        for found in _matches(patterns[0], inputs[0], bound):
            yield from _match_all(patterns[1:], inputs[1:], found)


def _same(a: Expression, b: Expression) -> bool:
    if a.value is None or b.value is None:
        return a is b
    return np.array_equal(a.value, b.value)


def in_order(x: Expression) -> list[Expression]:
    """``x`` and all it is made of, inputs first, each once."""
    order: dict[Expression, None] = {}
    stack = [(x, False)]
    while stack:
        node, complete = stack.pop()
        if complete:
            order.setdefault(node)
        elif node not in order:
            stack.append((node, True))
            stack.extend((part, False) for part in reversed(node.inputs))
    return list(order)


def rewrite(x: Expression, rules: Sequence[Rule]) -> Expression:
    """Apply the rules everywhere, from the inputs on, until none applies any more."""
    while True:
        result: dict[Expression, Expression] = {}
        for node in in_order(x):
            inputs = tuple(result[part] for part in node.inputs)
            changed = any(a is not b for a, b in zip(inputs, node.inputs, strict=True))
            result[node] = _apply(rules, replace(node, inputs=inputs) if changed else node)
        if result[x] is x:
            return x
        x = result[x]


def _apply(rules: Sequence[Rule], node: Expression) -> Expression:
    for rule in rules:
        found = rule(node)
        if found is not None:
            assert found.shape == node.shape, (rule.__name__, found.shape, node.shape)
            return _apply(rules, found)
    return node
