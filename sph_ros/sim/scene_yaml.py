# SPDX-License-Identifier: Apache-2.0
"""YAML files and dicts as one tree whose every node knows its place, and dataclasses made from it.

Nothing here knows what a scene is; scene.py says which keys mean what.
"""

import dataclasses
import difflib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

# Far above any scene, far below what aliases that contain aliases can unfold to.
MAX_NODES = 100_000

# YAML 1.1 takes 1e-3 for text, because it lacks the dot. People mean a number.
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+")
# How dataclasses name the field they refuse: `radius: ...`, `solids[1].name: ...`.
_NAMED_FIELD = re.compile(r"(\w+(?:\[\d+\]|\.\w+)*): (.*)", re.DOTALL)


class SceneError(ValueError):
    """Something is wrong with a scene; the text is one line that names file, line and key."""


@dataclass(frozen=True)
class Node:
    """A value of the file and where it stands.

    Attributes:
        value: dict of Nodes, list of Nodes, or a plain scalar.
        key: path from the top, e.g. `solids[1].sphere`; empty at the top.
        where: `file:line`, or `<dict>`.
    """

    value: object
    key: str
    where: str

    def error(self, text: str) -> SceneError:
        """A SceneError about this node."""
        place = f"{self.where}: {self.key}" if self.key else self.where
        return SceneError(f"{place}: {text}")

    def mapping(self) -> dict[str, "Node"]:
        """The value, which must be a mapping."""
        if not isinstance(self.value, dict):
            raise self.error(f"expected a mapping (key: value), got {self.describe()}")
        return self.value

    def items(self) -> list["Node"]:
        """The value, which must be a list."""
        if not isinstance(self.value, list):
            raise self.error(f"expected a list, got {self.describe()}")
        return self.value

    def text(self) -> str:
        """The value, which must be text."""
        if not isinstance(self.value, str):
            raise self.error(f"expected text, got {self.describe()}")
        return self.value

    def plain(self):
        """The value without its places: dicts, lists, scalars."""
        if isinstance(self.value, dict):
            return {key: child.plain() for key, child in self.value.items()}
        if isinstance(self.value, list):
            return [child.plain() for child in self.value]
        return self.value

    def describe(self) -> str:
        """The value as error messages show it."""
        if self.value is None:
            return "nothing"
        if isinstance(self.value, dict):
            return f"a mapping with {', '.join(self.value) or 'no keys'}"
        if isinstance(self.value, list):
            return f"a list of {len(self.value)}"
        return repr(self.value)


# ---------------------------------------------------------------- reading into a tree


def read_file(path: Path) -> Node:
    """The tree of a YAML file.

    Raises:
        SceneError: unreadable, not YAML, duplicate keys, more than one document.
    """
    try:
        with open(path, "rb") as stream:
            return _compose(stream, str(path))
    except OSError as error:
        raise SceneError(f"{path}: {error.strerror or error}") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise SceneError(f"{place}: not valid YAML: {error.problem or error.context}") from None
    except (yaml.YAMLError, UnicodeDecodeError, ValueError) as error:
        if isinstance(error, SceneError):
            raise
        raise SceneError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None


def _compose(stream, name: str) -> Node:
    loader = yaml.SafeLoader(stream)
    try:
        root = loader.get_single_node()
        if root is None:
            raise SceneError(f"{name}: empty, expected a mapping (key: value)")
        return _Tree(loader, name).node(root, "", root.start_mark.line)
    finally:
        loader.dispose()


class _Tree:
    """Turns composed YAML nodes into Nodes, keeping lines and refusing duplicate keys."""

    def __init__(self, loader, name):
        self.loader, self.name, self.count = loader, name, 0

    def node(self, node, key, line) -> Node:
        where = f"{self.name}:{line + 1}"
        self.count += 1
        if self.count > MAX_NODES or key.count(".") + key.count("[") > 60:
            raise SceneError(f"{where}: nested too deep or too many values; aliases in a circle?")
        if isinstance(node, yaml.MappingNode):
            return Node(self.children(node, key), key, where)
        if isinstance(node, yaml.SequenceNode):
            items = [
                self.node(item, f"{key}[{index}]", item.start_mark.line)
                for index, item in enumerate(node.value)
            ]
            return Node(items, key, where)
        value = self.loader.construct_object(node)
        if isinstance(value, str) and node.style is None and _NUMBER.fullmatch(value):
            value = float(value)
        return Node(value, key, where)

    def children(self, node, key) -> dict[str, Node]:
        first_lines = {}
        for name, _ in node.value:
            line = name.start_mark.line + 1
            if name.value in first_lines and name.value != "<<":
                raise SceneError(
                    f"{self.name}:{line}: {_join(key, name.value)}: given twice, first in line "
                    f"{first_lines[name.value]}"
                )
            first_lines[str(name.value)] = line
        self.loader.flatten_mapping(node)  # merges `<<: *alias`
        return {
            str(name.value): self.node(value, _join(key, name.value), name.start_mark.line)
            for name, value in node.value
        }


def read_dict(value: Mapping, where: str = "<dict>", key: str = "") -> Node:
    """The tree of a Python dict; tuples and arrays count as lists."""
    if key.count(".") + key.count("[") > 60:
        raise SceneError(f"{where}: nested too deep")
    if hasattr(value, "tolist"):  # NumPy arrays and scalars
        value = value.tolist()
    if isinstance(value, Mapping):
        children = {str(k): read_dict(v, where, _join(key, k)) for k, v in value.items()}
        return Node(children, key, where)
    if isinstance(value, (list, tuple)):
        items = [read_dict(v, where, f"{key}[{index}]") for index, v in enumerate(value)]
        return Node(items, key, where)
    return Node(str(value) if isinstance(value, Path) else value, key, where)


def _join(key, name):
    return f"{key}.{name}" if key else str(name)


# ---------------------------------------------------------------- dataclasses from a tree


def nearest(word: str, words) -> str:
    """`; did you mean 'x'? (a, b, c)`, without the question when nothing is near."""
    words = list(words)
    close = difflib.get_close_matches(word, words, n=1, cutoff=0.5)
    return (f"; did you mean {close[0]!r}?" if close else ";") + f" known: {', '.join(words)}"


def check_keys(node: Node, known) -> None:
    """Refuse keys that are not in `known`."""
    known = list(known)
    for name, child in node.mapping().items():
        if name not in known:
            raise child.error(f"unknown key{nearest(name, known)}")


def build(
    cls,
    node: Node,
    readers: Mapping[str, Callable[[Node], object]] | None = None,
    renamed: Mapping[str, str] | None = None,
    extra: Mapping[str, object] | None = None,
):
    """A dataclass from a mapping: keys are its fields, and it checks the values itself.

    Args:
        cls: the dataclass; it raises ValueError("field: what is wrong").
        node: the mapping.
        readers: for fields that are more than numbers and text; gets the field's Node.
        renamed: field -> key, where they differ.
        extra: values of fields that have no key in the file.

    Raises:
        SceneError: an unknown or missing key, or what `cls` refused, at the key's line.
    """
    readers, renamed, extra = readers or {}, renamed or {}, dict(extra or {})
    fields = {
        renamed.get(f.name, f.name): f for f in dataclasses.fields(cls) if f.name not in extra
    }
    check_keys(node, fields)
    children = node.mapping()
    values = extra
    for key, field in fields.items():
        if key in children:
            read = readers.get(field.name, Node.plain)
            if read is Node.plain and "unit" in field.metadata:
                _refuse_text(children[key], field.metadata["unit"])
            values[field.name] = read(children[key])
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            raise node.error(f"missing key {key!r}")
    try:
        return cls(**values)
    except SceneError:
        raise
    except ValueError as error:
        raise _located(error, node, fields, renamed) from None


def _refuse_text(node: Node, unit: str) -> None:
    """Say which unit a number must have where somebody wrote text, such as `10 cm`."""
    if isinstance(node.value, list):
        for child in node.value:
            _refuse_text(child, unit)
    elif isinstance(node.value, str) and node.value != "auto":
        wanted = "a plain number" if unit == "1" else f"a number in {unit}, without the unit"
        raise node.error(f"expected {wanted}; got {node.value!r}")


def _located(error: ValueError, node: Node, fields, renamed) -> SceneError:
    """The error a dataclass raised, at the line of the key it names."""
    match = _NAMED_FIELD.fullmatch(str(error))
    if not match:
        return node.error(str(error))
    named, text = match.groups()
    steps = re.findall(r"\w+", named)
    steps[0] = renamed.get(steps[0], steps[0])
    if steps[0] not in fields:
        return node.error(text if node.key.split(".")[-1].startswith(named) else str(error))
    top, where = node.key, node.where
    for step in steps:
        children = node.value if node is not None else None
        if isinstance(children, dict):
            node = children.get(step)
        elif isinstance(children, list) and step.isdigit() and int(step) < len(children):
            node = children[int(step)]
        else:
            node = None
        where = node.where if node is not None else where
    key = _join(top, re.sub(r"^\w+", steps[0], named))
    return Node(None, key, where).error(text)
