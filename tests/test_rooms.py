"""The architecture: who may import whom, and one home for every public name."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# From the top floor down; a room imports from its own floor and from those below.
FLOORS = [
    {"ilnet.__main__", "ilnet.course"},
    {"ilnet.commands"},
    {"ilnet.learning"},
    {"ilnet.data"},
    {"ilnet.models", "ilnet.world"},
    {"ilnet.scan_files"},
    {"ilnet.scan"},
    {"ilnet.fit"},
    {"ilnet.holes", "ilnet.sensor_files"},
    {"ilnet.sensor"},
    {"ilnet.sensors"},
    {"ilnet.memory"},
    {"kernels"},
]
FLOOR = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
# It offers short names of what lies in its rooms, and belongs to none.
SHORT_NAMES = "ilnet"


@cache
def modules():
    """Every module of both packages with its syntax tree."""
    found = {}
    for package in ("ilnet", "kernels"):
        for file in (ROOT / package).rglob("*.py"):
            parts = file.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(file.read_text())
    return found


def imported(tree):
    """The modules that a tree imports, in functions too; of `from a import b` it is a.b where that is a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in modules() else short(node.module, alias.name)


def short(module, name):
    """Where a short name of the package lies."""
    if module != SHORT_NAMES:
        return module
    return next((long for long in modules() if long.count(".") == 2 and long.endswith(f".{name}")), module)


def room(module):
    package, *rest = module.split(".")
    return package if package == "kernels" or not rest else f"{package}.{rest[0]}"


def ours(tree):
    return {name for name in imported(tree) if name.split(".")[0] in ("ilnet", "kernels")}


def test_every_module_has_a_room():
    assert {room(module) for module in modules()} - {SHORT_NAMES} == set(FLOOR)


def test_arrows_run_one_way():
    upward = [
        f"{module} -> {target}"
        for module, tree in modules().items()
        if module != SHORT_NAMES
        for target in ours(tree)
        if FLOOR[room(target)] < FLOOR[room(module)]
        or (FLOOR[room(target)] == FLOOR[room(module)] and room(target) != room(module))
    ]
    assert upward == []


def test_only_notebooks_use_the_course():
    assert [module for module, tree in modules().items() if "ilnet.course" in ours(tree)] == []


def test_kernels_know_neither_the_system_nor_pictures():
    known = {"ilnet", "pyvista", "matplotlib"}
    for module, tree in modules().items():
        if room(module) == "kernels":
            assert not known & {name.split(".")[0] for name in imported(tree)}, module


def test_no_module_imports_itself_over_others():
    """No circles, in the rooms themselves either."""
    arrows = {module: ours(tree) - {module} for module, tree in modules().items() if module != SHORT_NAMES}
    done = set()

    def walk(module, path):
        assert module not in path, "a circle: " + " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            for target in arrows.get(module, ()):
                walk(target, [*path, module])
            done.add(module)

    for module in arrows:
        walk(module, [])


def listed(tree):
    """What `__all__` lists."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            return ast.literal_eval(node.value)
    return []


def defined(tree):
    """The public names that a module's own statements make."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name))


@pytest.mark.parametrize("package", ["ilnet", "kernels"])
def test_a_public_name_has_one_home(package):
    """A module lists what it makes itself, each name once; only a package's `__init__` lists names of its modules."""
    for module, tree in modules().items():
        if room(module).split(".")[0] != package:
            continue
        names = listed(tree)
        assert len(set(names)) == len(names), module
        if not any(other.startswith(f"{module}.") for other in modules()):
            assert set(names) <= set(defined(tree)), module


def test_what_a_module_gives_to_others_is_in_its_list():
    private = [
        f"{module} takes {alias.name} from {node.module}"
        for module, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module in modules()
        for alias in node.names
        if f"{node.module}.{alias.name}" not in modules() and alias.name not in listed(modules()[node.module])
    ]
    assert private == []


def test_library_code_does_not_speak_of_options():
    """Outside `commands` errors name arguments; there they name options such as --size."""
    spoken = []
    for module, tree in modules().items():
        if FLOOR.get(room(module), 0) <= FLOOR["ilnet.commands"]:
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                spoken += [
                    f"{module}:{node.lineno} {word}" for word in re.findall(r"(?<![\w-])--[a-z][\w-]*", node.value)
                ]
    assert spoken == []
