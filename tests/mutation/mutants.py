"""Mutants of a source file: the same file with one small defect, one at a time.

Operators: arithmetic (+ with -, * with /), comparison turned round, `and` with `or`, `min` with `max`, a sign, an `abs`
or a `not` left out, a number doubled (0 becomes 1), and a condition taken as false. Left alone: docstrings, types,
messages of exceptions, subscripts and ranges of loops (an index that is off by one raises or is seen by every test),
numbers under TUNING (tolerances), and < against <= (they differ on a set of measure zero).
"""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType

TUNING = 1e-3  # numbers below are tolerances of floating point

ARITHMETIC = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult}
COMPARISON = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq}
PARTNERS = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all", "all": "any"}


@dataclass(frozen=True, slots=True)
class Mutant:
    path: Path
    function: str  # qualified name
    change: str  # "before -> after"
    tree: ast.Module
    node: ast.expr
    replacement: ast.expr

    @property
    def name(self) -> str:
        """Says what was changed and not in which line: lines move."""
        return f"{self.path.name} {self.function}: {self.change}"

    def code(self) -> CodeType:
        """The function's, with the defect. The tree is changed for good: a process makes one mutant of it."""
        node, replacement = self.node, self.replacement

        class Swap(ast.NodeTransformer):
            def visit(self, visited: ast.AST) -> ast.AST:
                return replacement if visited is node else self.generic_visit(visited)

        module = compile(ast.fix_missing_locations(Swap().visit(self.tree)), str(self.path), "exec")
        return next(code for code in _codes(module) if code.co_qualname == self.function)


def mutants(path: Path) -> list[Mutant]:
    """All mutants of the functions of one file, in the order of the source."""
    tree = ast.parse(path.read_text())
    found: list[Mutant] = []
    seen: Counter[str] = Counter()
    for name, function in _functions(tree):
        for node, replacement in _changes(function):
            change = f"{ast.unparse(node)} -> {ast.unparse(replacement)}"
            seen[f"{name} {change}"] += 1
            if (count := seen[f"{name} {change}"]) > 1:
                change += f" ({count})"
            found.append(Mutant(path, name, change, tree, node, replacement))
    return found


def _functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Of the module and of its classes, by qualified name; one inside another belongs to the outer one."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield node.name, node
        if isinstance(node, ast.ClassDef):
            yield from ((f"{node.name}.{f.name}", f) for f in node.body if isinstance(f, ast.FunctionDef))


def _codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)


def _changes(function: ast.FunctionDef) -> Iterator[tuple[ast.expr, ast.expr]]:
    for statement in function.body:
        yield from _visit(statement)


def _visit(node: ast.AST) -> Iterator[tuple[ast.expr, ast.expr]]:
    if isinstance(node, ast.Raise) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
        return
    if isinstance(node, ast.If | ast.IfExp):
        yield node.test, ast.Constant(False)
    if isinstance(node, ast.expr):
        for replacement in _replacements(node):
            yield node, ast.copy_location(replacement, node)
    for name, child in ast.iter_fields(node):
        if name in ("annotation", "slice") or (isinstance(node, ast.For) and name == "iter"):
            continue
        for inner in child if isinstance(child, list) else [child]:
            if isinstance(inner, ast.AST):
                yield from _visit(inner)


def _replacements(node: ast.expr) -> Iterator[ast.expr]:
    match node:
        case ast.BinOp(left, op, right) if type(op) in ARITHMETIC:
            yield ast.BinOp(left, ARITHMETIC[type(op)](), right)
        case ast.Compare(left, ops, comparators):
            for i, op in enumerate(ops):
                if type(op) in COMPARISON:
                    yield ast.Compare(left, [*ops[:i], COMPARISON[type(op)](), *ops[i + 1 :]], comparators)
        case ast.BoolOp(op, values):
            yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
        case ast.UnaryOp(ast.USub() | ast.Not(), operand) if not isinstance(operand, ast.Constant):
            yield operand
        case ast.Call(ast.Name(name), arguments, keywords) if name in PARTNERS:
            yield ast.Call(ast.Name(PARTNERS[name], ast.Load()), arguments, keywords)
        case ast.Call(ast.Attribute(owner, name), arguments, keywords) if name in PARTNERS:
            yield ast.Call(ast.Attribute(owner, PARTNERS[name], ast.Load()), arguments, keywords)
        case ast.Call(ast.Name("abs") | ast.Attribute(attr="abs"), [argument]):
            yield argument
        case ast.Constant(float(value)) if value == 0.0 or abs(value) >= TUNING:
            yield ast.Constant(2.0 * value or 1.0)
