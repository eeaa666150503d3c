"""Places in a source to break: signs, terms, products, sines, constants, indices, comparisons.

Only the bodies of functions count. Numbers that are no part of an equation are left alone: those below
SMALL or above LARGE are tolerances and limits, not coefficients.

Own, because mutmut passes over decorated functions, which all of the compiled kernel is, and neither it
nor cosmic-ray swaps sin and cos or axes, or keeps the machine code of what a mutation did not touch.
"""

import ast
import hashlib
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

SMALL, LARGE = 0.01, 100.0
"""Sizes between which a number is taken for an equation's own."""

_SIGNS = {ast.Add: ("+", "-"), ast.Sub: ("-", "+")}
_PRODUCTS = {ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
_COMPARISONS = {
    ast.Lt: ("<", ">="), ast.GtE: (">=", "<"), ast.Gt: (">", "<="), ast.LtE: ("<=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="),
}  # fmt: skip
_FUNCTIONS = {"sin": "cos", "cos": "sin", "sin_phi": "cos_phi", "cos_phi": "sin_phi",
              "sin_theta": "cos_theta", "cos_theta": "sin_theta"}  # fmt: skip
_PLACES = {
    "_U": "_L", "_L": "_U", "_X": "_Y", "_Y": "_X", "_Z": "_X", "_XX": "_YY", "_YY": "_XX",
    "_ZZ": "_XX", "_LON": "_LAT", "_LAT": "_LON", "_PHI": "_THETA", "_THETA": "_PHI",
}  # fmt: skip
_NAMED = re.compile(r"(_U|_L|_X|_Y|_Z|_XX|_YY|_ZZ|_LON|_LAT|_PHI|_THETA)$")


@dataclass(frozen=True)
class Mutation:
    """One change of one file: the text from `start` to `stop` becomes `new`.

    ``before`` and ``after`` are the lines it stands in, stripped, and `place` the function and which of
    its like in that function it is: what names the mutation wherever in the file it stands.
    """

    file: str
    kind: str
    start: int
    stop: int
    new: str
    line: int
    before: str
    after: str
    place: str

    @property
    def name(self) -> str:
        """Twelve hex digits that stay the same while other lines change."""
        words = "\0".join((self.file, self.kind, self.place, self.before, self.after))
        return hashlib.sha256(words.encode()).hexdigest()[:12]

    def applied(self, text: str) -> str:
        """The file's text, broken."""
        return text[: self.start] + self.new + text[self.stop :]


def sites(file: str, text: str) -> list[Mutation]:
    """Every mutation of a file, in the order of its text."""
    offsets = _line_offsets(text)

    def at(line: int, column: int) -> int:
        row = text[offsets[line - 1] : offsets[line]]
        return offsets[line - 1] + len(row.encode()[:column].decode())

    def span(node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        return at(node.lineno, node.col_offset), at(node.end_lineno, node.end_col_offset)

    found: list[Mutation] = []
    seen: dict[tuple[str, ...], int] = {}
    for function, node in _in_functions(ast.parse(text)):
        for kind, start, stop, new in _changes(node, text, span):
            first = text.count("\n", 0, start)
            last = text.count("\n", 0, stop)
            left, right = offsets[first], offsets[last + 1]
            before = " ".join(text[left:right].split())
            after = " ".join((text[left:start] + new + text[stop:right]).split())
            like = (function, kind, before, after)
            seen[like] = seen.get(like, 0) + 1
            place = f"{function} {seen[like]}"
            found.append(Mutation(file, kind, start, stop, new, first + 1, before, after, place))
    return sorted(found, key=lambda m: (m.start, m.kind))


def _line_offsets(text: str) -> list[int]:
    offsets = [0]
    for line in text.splitlines(keepends=True):
        offsets.append(offsets[-1] + len(line))
    return [*offsets, len(text)]


def _in_functions(tree: ast.Module) -> Iterator[tuple[str, ast.AST]]:
    """Nodes of the functions' bodies with the function's name; no annotation, default or message."""

    def walk(node: ast.AST, function: str) -> Iterator[tuple[str, ast.AST]]:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            name = f"{function}.{node.name}".lstrip(".")
            for statement in node.body:
                if isinstance(node, ast.FunctionDef) or isinstance(statement, ast.FunctionDef):
                    yield from walk(statement, name)
            return
        if not function or isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr):
            return
        yield function, node
        for child in ast.iter_child_nodes(node):
            if not (isinstance(node, ast.AnnAssign) and child is node.annotation):
                yield from walk(child, function)

    yield from (part for statement in tree.body for part in walk(statement, ""))


Span = Callable[[ast.expr], tuple[int, int]]
_Change = tuple[str, int, int, str]


def _changes(node: ast.AST, text: str, span: Span) -> Iterator[_Change]:
    """What can be broken at a node: kind, start, stop, new text."""
    if isinstance(node, ast.BinOp) and not _is_text_or_list(node.left, node.right):
        yield from _of_operator(node, text, span)
    elif isinstance(node, ast.AugAssign):
        yield from _swapped(node.op, node.target, node.value, text, span)
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        if not (isinstance(node.operand, ast.Constant) and isinstance(node.operand.value, int)):
            start, _ = span(node)
            yield "sign", start, start + 1, ""
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        for old, new in [_COMPARISONS.get(type(node.ops[0]), ("", ""))]:
            if old:
                yield _token("comparison", old, new, node.left, node.comparators[0], text, span)
    elif isinstance(node, ast.Attribute | ast.Name):
        yield from _of_function(node, span)
    elif isinstance(node, ast.Constant) and isinstance(node.value, float):
        if SMALL <= node.value <= LARGE:
            yield "constant", *span(node), repr(2.0 * node.value)
    elif isinstance(node, ast.Subscript):
        yield from _of_place(node, span)


def _of_operator(node: ast.BinOp, text: str, span: Span) -> Iterator[_Change]:
    yield from _swapped(node.op, node.left, node.right, text, span)
    numbers = isinstance(node.left, ast.Constant) or isinstance(node.right, ast.Constant)
    if isinstance(node.op, ast.Add | ast.Sub) and not numbers:
        start, stop = span(node)
        _, operator, _, _ = _token(
            "", _SIGNS[type(node.op)][0], "", node.left, node.right, text, span
        )
        yield "term", start, stop, text[start:operator].rstrip()


def _swapped(
    op: ast.operator, left: ast.expr, right: ast.expr, text: str, span: Span
) -> Iterator[_Change]:
    for kind, table in (("sign", _SIGNS), ("product", _PRODUCTS)):
        if type(op) in table:
            yield _token(kind, *table[type(op)], left, right, text, span)


def _token(
    kind: str, old: str, new: str, left: ast.expr, right: ast.expr, text: str, span: Span
) -> _Change:
    """An operator between two expressions, for another one."""
    (_, start), (stop, _) = span(left), span(right)
    between = re.sub(r"#[^\n]*", lambda comment: " " * len(comment[0]), text[start:stop])
    place = start + between.index(old)
    return kind, place, place + len(old), new


def _of_function(node: ast.Attribute | ast.Name, span: Span) -> Iterator[_Change]:
    """Sine for cosine."""
    name = node.attr if isinstance(node, ast.Attribute) else node.id
    if name in _FUNCTIONS and isinstance(node.ctx, ast.Load):
        _, stop = span(node)
        yield "function", stop - len(name), stop, _FUNCTIONS[name]


def _of_place(node: ast.Subscript, span: Span) -> Iterator[_Change]:
    """Another element: the one before (of the first, the one after), or one named for another axis."""
    if isinstance(node.value, ast.Attribute) and node.value.attr == "shape":
        return
    indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
    for index in indices:
        if isinstance(index, ast.Constant) and type(index.value) is int:
            yield "index", *span(index), str(index.value - 1 if index.value else 1)
        elif isinstance(index, ast.Attribute) and (named := _NAMED.search(index.attr)):
            _, stop = span(index)
            yield "index", stop - len(named[0]), stop, _PLACES[named[0]]


def _is_text_or_list(*sides: ast.expr) -> bool:
    return any(
        isinstance(side, ast.JoinedStr | ast.List | ast.Tuple)
        or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in sides
    )
