"""Arrays outlive their addresses: Numba frees an array after its last mention, and an address mentions none."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

KERNELS = Path(__file__).parents[2] / "icheat_usd" / "kernels"


def assignments(function: ast.FunctionDef) -> Iterator[tuple[str, ast.expr]]:
    """Names and what they are given, tuples taken apart where both sides are."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assign):
            for target in node.targets:
                names = target.elts if isinstance(target, ast.Tuple) else [target]
                values = [node.value] * len(names)
                if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                    values = node.value.elts
                yield from ((n.id, v) for n, v in zip(names, values, strict=True) if isinstance(n, ast.Name))
        elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            yield node.target.id, node.value


def root(value: ast.expr) -> str | None:
    """Name that an array is a part or another view of."""
    while not isinstance(value, ast.Name):
        if isinstance(value, ast.Attribute) and value.attr in ("ctypes", "shape", "size"):
            return None
        if isinstance(value, ast.Subscript | ast.Attribute):
            value = value.value
        elif isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute):
            if value.func.attr not in ("view", "reshape", "ravel"):
                return None
            value = value.func.value
        else:
            return None
    return value.id


def addressed(value: ast.expr) -> set[str]:
    """Names of arrays whose address is taken."""
    found = set()
    for node in ast.walk(value):
        if isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] == "address_of":
            found.add(root(node.args[0]))
        elif isinstance(node, ast.Attribute) and node.attr == "ctypes":
            found.add(root(node.value))
    return {name for name in found if name is not None}


def last_line(function: ast.FunctionDef, names: set[str], born: int) -> int:
    """Last line where one of the names is alive: a loop that mentions what came before it does so in its last round."""
    last = 0
    for node in ast.walk(function):
        if isinstance(node, ast.Name) and node.id in names:
            last = max(last, node.lineno)
    for node in ast.walk(function):
        inside = {child.id for child in ast.walk(node) if isinstance(child, ast.Name)}
        if isinstance(node, ast.For | ast.While) and node.lineno > born and inside & names:
            last = max(last, node.end_lineno or 0)
    return last


def freed_too_early(source: str) -> list[str]:
    """Arrays of kernels that are last mentioned before their address is last used."""
    found = []
    for function in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)):
        given = list(assignments(function))
        borrowed = {argument.arg for argument in function.args.args}  # the caller keeps them
        parents = {name: {root(v) for n, v in given if n == name} for name, _ in given}
        for _ in parents:
            borrowed |= {name for name, roots in parents.items() if roots <= borrowed}
        taken: set[str] = set().union(*(addressed(value) for _, value in given)) - borrowed
        for array in sorted(taken):
            family = {array}
            for _ in parents:
                family |= {name for name, roots in parents.items() if roots & family}
                family |= {above for name in family for above in parents.get(name, set()) if above} - borrowed
            addresses = {name for name, value in given if addressed(value) & family} - family
            for _ in given:  # addresses that are reckoned from addresses
                addresses |= {
                    name
                    for name, value in given
                    if isinstance(value, ast.BinOp)
                    and {n.id for n in ast.walk(value) if isinstance(n, ast.Name)} & addresses
                }
            born = min(n.lineno for n in ast.walk(function) if isinstance(n, ast.Name) and n.id == array)
            if last_line(function, addresses, function.lineno) > last_line(function, family, born):
                found.append(f"{function.name}: {array}")
    return found


@pytest.mark.parametrize("path", sorted(KERNELS.glob("*.py")), ids=lambda path: path.stem)
def test_arrays_are_mentioned_after_the_last_use_of_their_address(path: Path) -> None:
    assert freed_too_early(path.read_text()) == []


def test_the_look_finds_what_it_looks_for() -> None:
    wrong = "def f(out):\n a = np.empty(4)\n p = address_of(a) + 4\n for i in range(4):\n  q = p + i\n  store(q, 1)\n"
    assert freed_too_early(wrong) == ["f: a"]
    assert freed_too_early(wrong + " a[0] = 0\n") == []
    assert freed_too_early(wrong.replace("a = np.empty(4)", "a = out[2:]")) == []
    inside = "def f():\n a = np.empty(4)\n p = a.ctypes.data\n for i in range(4):\n  a[i] = 0\n  store(p, i)\n"
    assert freed_too_early(inside) == []
    assert freed_too_early(inside.replace("  a[i] = 0\n", "")) == ["f: a"]
