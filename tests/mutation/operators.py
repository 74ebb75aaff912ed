"""What is changed in a module to see whether its tests notice: one place of its syntax tree at a time.

Left out, because no behaviour of the code hangs on it: docstrings, annotations, imports, __all__, decorators, the
texts of messages. Strings are left out as well: a wrong key raises by itself. So is the boundary of
``b if b < a else a``, where both are the same number.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

from proof.symbolic_execution import selection

_Node = TypeVar("_Node", bound=ast.AST)
_Statement = ast.stmt | ast.ExceptHandler | ast.keyword
_LONG = 200  # Characters of a statement that nobody reads to its end
_BINARY: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitOr,
}
_BOUNDARY: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
_RELATION = {
    "lt": ("gt", "le"),
    "gt": ("lt", "ge"),
    "le": ("ge", "lt"),
    "ge": ("le", "gt"),
}  # Functions of the module ``operator``
_OTHER_FUNCTION = {"min": "max", "max": "min", "ceil": "floor", "floor": "ceil", "round": "int"}
_ONE_OF_ITS_ARGUMENTS = {"min", "max", "abs"}
_DELETED = (ast.Expr, ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Raise, ast.Assert, ast.Delete)
_LEFT_OUT = (ast.JoinedStr, ast.Import, ast.ImportFrom)
_TESTED = (ast.If, ast.While, ast.IfExp, ast.Assert)


@dataclass
class Change:
    """One change of a tree, not made yet: ``holder.field``, or its entry ``index``, becomes ``new``."""

    operator: str
    where: str  # Qualified name of the function or class
    statement: _Statement  # The innermost one that it is in, or the keyword argument in a long one
    holder: ast.AST
    field: str
    index: int | None
    new: ast.AST

    @property
    def line(self) -> int:
        """Line of the change in the source."""
        line = getattr(self._old(), "lineno", self.statement.lineno)
        assert isinstance(line, int)
        return line

    def make(self) -> None:
        """Change the tree."""
        self._put(ast.fix_missing_locations(ast.copy_location(self.new, self.statement)))

    def texts(self) -> tuple[str, str]:
        """The statement before and after, without the block below it."""
        old = self._old()
        before = _text(self.statement)
        self._put(self.new)
        after = _text(self.new if self.statement is old else self.statement)
        self._put(old)
        return before, after

    def _put(self, node: ast.AST) -> None:
        if self.index is None:
            setattr(self.holder, self.field, node)
        else:
            getattr(self.holder, self.field)[self.index] = node

    def _old(self) -> ast.AST:
        value = getattr(self.holder, self.field)
        old = value if self.index is None else value[self.index]
        assert isinstance(old, ast.AST)
        return old


def changes(tree: ast.Module) -> Iterator[Change]:
    """Every change of a module, in the order of its source; a tree is good for making one of them."""
    yield from _below(tree, "", None)


def _below(node: ast.AST, where: str, statement: _Statement | None) -> Iterator[Change]:
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        where = f"{where}.{node.name}".lstrip(".")
    long = statement is not None and len(_text(statement)) > _LONG
    if isinstance(node, (ast.stmt, ast.ExceptHandler)) or (long and isinstance(node, ast.keyword)):
        statement = node
    for field, value in ast.iter_fields(node):
        if field in ("annotation", "returns", "decorator_list", "bases"):
            continue
        for index, child in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(child, ast.AST) or _is_left_out(child):
                continue
            inside = child if isinstance(child, (ast.stmt, ast.ExceptHandler)) else statement
            for operator, new in _variants(child, node, field):
                assert inside is not None
                yield Change(operator, where, inside, node, field, index, new)
            yield from _below(child, where, statement)


def _is_left_out(node: ast.AST) -> bool:
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True  # a docstring
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return True
    if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
        return True
    return isinstance(node, _LEFT_OUT)


def _variants(node: ast.AST, parent: ast.AST, field: str) -> Iterator[tuple[str, ast.AST]]:
    """What stands in place of a node, and what that is called."""
    if isinstance(node, ast.stmt):
        yield from _of_statement(node)
    elif isinstance(node, ast.expr):
        if _is_condition(node, parent, field):
            yield "condition", ast.Constant(True)
            yield "condition", ast.Constant(False)
        yield from _of_expression(node, parent)
    elif isinstance(node, ast.ExceptHandler) and node.type is not None:
        for fewer in _without_one(node.type) if isinstance(node.type, ast.Tuple) else [ast.Tuple([], ast.Load())]:
            yield "exception", _with(node, type=fewer)
    elif isinstance(node, ast.comprehension):
        for index in range(len(node.ifs)):
            yield "condition", _with(node, ifs=node.ifs[:index] + node.ifs[index + 1 :])


def _of_statement(node: ast.stmt) -> Iterator[tuple[str, ast.AST]]:
    if isinstance(node, _DELETED) and not (isinstance(node, ast.AnnAssign) and node.value is None):
        yield "deletion", ast.Pass()
    elif isinstance(node, ast.Return):
        if node.value is not None and not _is_constant(node.value, None):
            yield "return", ast.Return(ast.Constant(None))
    elif isinstance(node, ast.Break):
        yield "break", ast.Continue()
    elif isinstance(node, ast.Continue):
        yield "break", ast.Break()
    elif isinstance(node, ast.For):
        yield "loop", _with(node, iter=ast.Tuple([], ast.Load()))
    if isinstance(node, ast.AugAssign):
        yield "arithmetic", _with(node, op=_BINARY[type(node.op)]())


def _is_condition(node: ast.expr, parent: ast.AST, field: str) -> bool:
    """Whether it is true or false as a whole; the parts of one lose a part instead."""
    if isinstance(parent, ast.BoolOp) or (isinstance(parent, ast.UnaryOp) and isinstance(parent.op, ast.Not)):
        return False
    if isinstance(parent, _TESTED) and field == "test":
        return not isinstance(node, ast.Constant)
    if isinstance(node, ast.BoolOp):
        return all(_is_truth(value) for value in node.values)
    return _is_truth(node)


def _is_truth(node: ast.expr) -> bool:
    return isinstance(node, ast.Compare) or (isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not))


def _of_expression(node: ast.expr, parent: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(node, ast.Constant):
        yield from _other_constants(node)
    elif isinstance(node, ast.BoolOp):
        for index in range(len(node.values)):
            rest = node.values[:index] + node.values[index + 1 :]
            yield "operand", _with(node, values=rest) if len(rest) > 1 else rest[0]
    elif isinstance(node, ast.Compare):
        yield from _other_comparisons(node, parent)
    elif isinstance(node, ast.BinOp):
        yield "arithmetic", _with(node, op=_BINARY[type(node.op)]())
    elif isinstance(node, ast.UnaryOp) and not isinstance(node.op, ast.Not):
        yield "sign", node.operand
    elif isinstance(node, ast.Name) and node.id in _RELATION:
        yield from (("relation", _with(node, id=other)) for other in _RELATION[node.id])
    elif isinstance(node, ast.Call):
        yield from _other_calls(node)
    elif isinstance(node, ast.Dict):
        for index in range(len(node.keys)):
            keys, values = list(node.keys), list(node.values)
            del keys[index], values[index]
            yield "element", _with(node, keys=keys, values=values)
    elif isinstance(node, (ast.List, ast.Set)) or (isinstance(node, ast.Tuple) and isinstance(parent, ast.Compare)):
        yield from (("element", fewer) for fewer in _without_one(node))


def _other_constants(node: ast.Constant) -> Iterator[tuple[str, ast.expr]]:
    value = node.value
    if isinstance(value, bool):
        yield "constant", ast.Constant(not value)
    elif isinstance(value, int):
        yield "constant", ast.Constant(value + 1)
        yield "constant", ast.Constant(value - 1)
    elif isinstance(value, float):
        yield "constant", ast.Constant(value * 1.1 if value else 1.0)
        yield "constant", ast.Constant(value * 0.9 if value else -1.0)


def _other_comparisons(node: ast.Compare, parent: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(parent, ast.IfExp) and selection(parent):
        return
    for index, operator in enumerate(node.ops):
        if type(operator) in _BOUNDARY:
            ops = list(node.ops)
            ops[index] = _BOUNDARY[type(operator)]()
            yield "boundary", _with(node, ops=ops)
    if len(node.ops) > 1:
        yield "operand", _with(node, ops=node.ops[1:], left=node.comparators[0], comparators=node.comparators[1:])
        yield "operand", _with(node, ops=node.ops[:-1], comparators=node.comparators[:-1])


def _other_calls(node: ast.Call) -> Iterator[tuple[str, ast.expr]]:
    function = node.func
    name = function.id if isinstance(function, ast.Name) else getattr(function, "attr", "")
    if name in _OTHER_FUNCTION:
        new = copy.copy(function)
        setattr(new, "id" if isinstance(new, ast.Name) else "attr", _OTHER_FUNCTION[name])
        yield "function", _with(node, func=new)
    if name in _ONE_OF_ITS_ARGUMENTS and not isinstance(node.args[0], (ast.GeneratorExp, ast.Starred)):
        for argument in node.args[:2]:
            yield "argument", argument


def _without_one(node: ast.List | ast.Set | ast.Tuple) -> Iterator[ast.expr]:
    for index in range(len(node.elts)):
        yield _with(node, elts=node.elts[:index] + node.elts[index + 1 :])


def _is_constant(node: ast.expr, value: object) -> bool:
    return isinstance(node, ast.Constant) and node.value is value


def _with(node: _Node, **fields: object) -> _Node:
    new = copy.copy(node)
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def _text(node: ast.AST) -> str:
    """A statement's source on one line, without the block below it."""
    head = copy.copy(node)
    for field in ("body", "orelse", "finalbody", "handlers"):
        if isinstance(getattr(head, field, None), list):
            setattr(head, field, [ast.Pass()] if field == "body" else [])
    if isinstance(head, ast.Try):
        return "try"
    return ast.unparse(head).removesuffix("\n    pass")
