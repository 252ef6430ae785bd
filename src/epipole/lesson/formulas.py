"""Formulas in texts: a small notation between dollar signs becomes MathML, which browsers set as mathematics.

`$d = @1{x_L} - @2{x_R} = f B / Z$` has identifiers, numbers and operators as they are. Besides:

- `a_b`, `a^b`, `a'`: subscript, superscript and prime; each script is one symbol or a group in braces
- `{a}/{b}`: a fraction of two groups; `/` between other symbols stays an operator
- `hat{x}`, `sqrt{x}`, `mat{a, b; c, d}`: hat, square root, matrix
- `@1{...}`, `@2{...}`, `@3{...}`: in the color in which figures mark the same thing
- `"text"`: words; `~`: a wide space
"""

from __future__ import annotations

import re
from collections.abc import Iterator

TOKEN = re.compile(r'\s*(@[123]|hat|sqrt|mat|"[^"]*"|\d+(?:\.\d+)?|[^\W\d_]|[{}_^/;,]|\S)')
LOWERED = '<mpadded voffset="-0.15em">{}</mpadded>'
"""A subscript: without a font for mathematics, browsers hardly lower it."""
FORMULA = re.compile(r"\$([^$]+)\$")


def with_formulas(text: str) -> str:
    """Replace each `$...$` by MathML."""
    return FORMULA.sub(lambda found: mathml(found[1]), text)


def mathml(notation: str) -> str:
    """One formula as a `math` element; ValueError if a brace or an argument is missing."""
    return f"<math><mrow>{_Parser(TOKEN.findall(notation)).row(ends=())}</mrow></math>"


class _Parser:
    """Recursive descent over the tokens."""

    def __init__(self, tokens: list[str]) -> None:
        self.tokens = tokens

    def row(self, ends: tuple[str, ...]) -> str:
        """Everything up to one of the ending tokens, which stays."""
        parts = []
        while self.tokens and self.tokens[0] not in ends:
            parts.append(self.scripted())
        return "".join(parts)

    def scripted(self) -> str:
        """One symbol with its subscript and superscript, or a fraction."""
        is_group = self.tokens[0] == "{"
        base = self.symbol()
        if is_group and self.tokens[:2] == ["/", "{"]:
            self.tokens.pop(0)
            return f"<mfrac>{base}{self.symbol()}</mfrac>"
        while self.tokens and self.tokens[0] == "'":
            base = f"<mrow>{base}{_leaf(self.tokens.pop(0))}</mrow>"
        scripts = dict(self.scripts())
        if not scripts:
            return base
        kind = {("_",): "msub", ("^",): "msup", ("^", "_"): "msubsup"}[tuple(sorted(scripts))]
        return f"<{kind}>{base}{scripts.get('_', '')}{scripts.get('^', '')}</{kind}>"

    def scripts(self) -> Iterator[tuple[str, str]]:
        """Marks and their scripts."""
        while self.tokens and self.tokens[0] in ("_", "^"):
            mark, script = self.tokens.pop(0), self.symbol()
            yield mark, LOWERED.format(script) if mark == "_" else script

    def symbol(self) -> str:
        """One token or group."""
        if not self.tokens:
            raise ValueError("A formula ends where a symbol must follow.")
        token = self.tokens.pop(0)
        if token == "{":
            return f"<mrow>{self.until('}')}</mrow>"
        if token == "hat":
            return f'<mover accent="true">{self.symbol()}<mo>^</mo></mover>'
        if token == "sqrt":
            return f"<msqrt>{self.symbol()}</msqrt>"
        if token == "mat":
            return self.matrix()
        if token[0] == "@":
            return f'<mrow class="s{token[1]}">{self.symbol()}</mrow>'
        return _leaf(token)

    def until(self, end: str) -> str:
        inner = self.row(ends=(end,))
        if not self.tokens:
            raise ValueError(f"A formula lacks {end!r}.")
        self.tokens.pop(0)
        return inner

    def matrix(self) -> str:
        self.tokens.pop(0)
        rows, cells = [], []
        while True:
            cells.append(f"<mtd>{self.row(ends=(',', ';', '}'))}</mtd>")
            if not self.tokens:
                raise ValueError("A formula lacks '}' after a matrix.")
            end = self.tokens.pop(0)
            if end != ",":
                rows.append(f"<mtr>{''.join(cells)}</mtr>")
                cells = []
            if end == "}":
                return f"<mrow><mo>[</mo><mtable>{''.join(rows)}</mtable><mo>]</mo></mrow>"


def _leaf(token: str) -> str:
    if token[0] == '"':
        return f"<mtext>{token[1:-1]}</mtext>"
    if token[0].isdigit():
        return f"<mn>{token}</mn>"
    if token[0].isalpha():
        return f"<mi>{token}</mi>"
    if token == "~":
        return '<mspace width="1.5em"/>'
    shown = {"-": "−", "<": "&lt;", ">": "&gt;", "&": "&amp;", "'": "′", "*": "·"}.get(token, token)
    if token in "()[]|'":
        return f'<mo stretchy="false" lspace="0" rspace="0">{shown}</mo>'
    return f"<mo>{shown}</mo>"
