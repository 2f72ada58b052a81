"""ROS 2 message definitions in OMG IDL (`ros2idl`), turned into the .msg text that decoders read.

A subset, which is what rosidl writes: modules, structs, typedefs of arrays and sequences, enums (as uint32), constants
(skipped), annotations and comments (ignored). IDL 4.2 (OMG formal/2018-01-05) has much more; that is refused by name.
"""

from __future__ import annotations

import re

PRIMITIVES = {
    "boolean": "bool", "octet": "uint8", "char": "uint8", "float": "float32", "double": "float64", "string": "string", "wstring": "wstring",
    "int8": "int8", "uint8": "uint8", "int16": "int16", "uint16": "uint16", "int32": "int32", "uint32": "uint32", "int64": "int64",
    "uint64": "uint64", "short": "int16", "unsigned short": "uint16", "long": "int32", "unsigned long": "uint32", "long long": "int64",
    "unsigned long long": "uint64",
}  # fmt: skip
_TOKEN = re.compile(r'"(?:\\.|[^"\\])*"|\'(?:\\.|[^\'\\])\'|[A-Za-z_][A-Za-z0-9_]*|[0-9][0-9a-zA-Z.+-]*|::|[{}\[\]()<>;,=@:|&*/+-]')


class IdlError(ValueError):
    """A definition that is not read; the text says what it has."""


def to_msg(name: str, text: str) -> str:
    """The .msg definition of struct `name` ("pkg/msg/Name") with those it needs behind it, from IDL (one section a file, as MCAP
    stores them). Raises IdlError."""
    structs = _Parser(text).structs
    root = _key(name)
    if root not in structs:
        raise IdlError(f"{name} is not defined in it; defined: {', '.join(structs) or 'nothing'}")
    order, todo = [], [root]
    while todo:
        key = todo.pop(0)
        if key in order:
            continue
        if key not in structs:
            raise IdlError(f"{key} is used and not defined in it")
        order.append(key)
        todo += [need for _, _, need in structs[key] if need]
    rule = "=" * 80
    parts = ["\n".join(f"{kind} {field}" for kind, field, _ in structs[root])]
    parts += [f"{rule}\nMSG: {key}\n" + "\n".join(f"{kind} {field}" for kind, field, _ in structs[key]) for key in order[1:]]
    return "\n".join(parts) + "\n"


def _key(name: str) -> str:
    """pkg/Name of pkg/msg/Name or pkg::msg::Name."""
    parts = [p for p in re.split(r"::|/", name) if p]
    return f"{parts[0]}/{parts[-1]}"


class _Parser:
    """structs: pkg/Name -> [(.msg type, field, the struct it needs or "")]."""

    def __init__(self, text: str):
        text = re.sub(r"^={3,}\s*$|^IDL:.*$|^\s*#.*$", "", text, flags=re.M)
        text = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.S)
        self._tokens, self._at = _TOKEN.findall(text), 0
        self.structs: dict[str, list[tuple[str, str, str]]] = {}
        self._aliases: dict[str, tuple[str, str]] = {}  # pkg/Name -> (.msg type, struct needed)
        self._module([])

    def _next(self) -> str:
        self._at += 1
        if self._at > len(self._tokens):
            raise IdlError("it ends in the middle of a definition")
        return self._tokens[self._at - 1]

    def _peek(self) -> str:
        return self._tokens[self._at] if self._at < len(self._tokens) else ""

    def _expect(self, token: str) -> None:
        got = self._next()
        if got != token:
            raise IdlError(f"'{token}' expected, found '{got}'")

    def _annotations(self) -> None:
        while self._peek() == "@":
            self._next()
            self._next()
            while self._peek() == "::":
                self._next()
                self._next()
            if self._peek() == "(":
                depth = 0
                while True:
                    depth += {"(": 1, ")": -1}.get(self._next(), 0)
                    if depth == 0:
                        break

    def _until(self, token: str) -> None:
        while self._next() != token:
            pass

    def _module(self, path: list[str]) -> None:
        while self._peek() not in ("", "}"):
            self._annotations()
            word = self._next()
            if word == "module":
                inner = [*path, self._next()]
                self._expect("{")
                self._module(inner)
                self._expect("}")
                self._expect(";")
            elif word == "struct":
                name = self._next()
                self._expect("{")
                self.structs[_key("/".join([*path, name]))] = self._fields(path)
                self._expect(";")
            elif word == "typedef":
                kind, need = self._type(path)
                name = self._next()
                self._aliases[_key("/".join([*path, name]))] = self._array(kind), need
                self._expect(";")
            elif word == "enum":
                self._aliases[_key("/".join([*path, self._next()]))] = "uint32", ""
                self._until("}")
                self._expect(";")
            elif word == "const":
                self._until(";")
            elif word != ";":
                raise IdlError(f"'{word}' is not read")

    def _fields(self, path: list[str]) -> list[tuple[str, str, str]]:
        out = []
        while True:
            self._annotations()
            if self._peek() == "}":
                self._next()
                return out
            kind, need = self._type(path)
            while True:
                name = self._next()
                out.append((self._array(kind), name, need))
                if self._next() == ";":
                    break  # else a comma: another field of this type

    def _array(self, kind: str) -> str:
        if self._peek() != "[":
            return kind
        self._next()
        size = self._next()
        self._expect("]")
        if "[" in kind or self._peek() == "[":
            raise IdlError("arrays of arrays are not read")
        return f"{kind}[{size}]"

    def _type(self, path: list[str]) -> tuple[str, str]:
        """(.msg type, the struct it needs or "")."""
        word = self._next()
        if word == "sequence":
            self._expect("<")
            kind, need = self._type(path)
            bound = ""
            if self._peek() == ",":
                self._next()
                bound = f"<={self._next()}"
            self._expect(">")
            if "[" in kind:
                raise IdlError("sequences of arrays are not read")
            return f"{kind}[{bound}]", need
        while word in ("unsigned", "unsigned long", "long") and self._peek() in ("short", "long"):
            word += f" {self._next()}"
        if word in PRIMITIVES:
            if word in ("string", "wstring") and self._peek() == "<":
                self._until(">")
            return PRIMITIVES[word], ""
        if word == "::":
            word = self._next()
        parts = [word]
        while self._peek() == "::":
            self._next()
            parts.append(self._next())
        key = _key("/".join(parts if len(parts) > 1 else [*path, word]))
        return self._aliases.get(key, (key, key))
