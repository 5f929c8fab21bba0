"""The rules of the house that a machine can check."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "shared" / "pliant"
SERVICES = ROOT / "services" / "pliant_services"

# Who may import whom; a room that is not listed may import every room of the library.
MAY_IMPORT: dict[str, set[str]] = {
    "compiler": {"compiler", "cache", "errors"},
    "algorithms": {"algorithms", "compiler"},
    "errors": set(),
    "open3d_library": {"errors"},
    "open3d_geometry": {"open3d_library", "algorithms"},
    "cache": set(),
    "files": set(),
    "staging": {"files"},
    "exit_codes": set(),
    "programs": set(),
    "version": set(),
    "wording": set(),
    "text_files": set(),
    "yaml_text": set(),
    "trajectory": {"algorithms"},
    "formats": {"formats", "algorithms", "errors", "files", "trajectory"},
    "pictures": {"pictures", "formats", "algorithms", "errors"},
    "map_history": {"algorithms", "trajectory"},
    "config": {"algorithms", "errors"},
    "messages": {"messages", "algorithms", "errors"},
    "bus": {"bus", "messages", "state", "algorithms", "errors", "files"},
    "recording": {"recording", "messages", "algorithms", "errors", "files"},
    "rendering": {"rendering", "algorithms", "compiler", "errors"},
    "ros": {"ros", "errors"},
    "viewers": {"viewers", "messages", "datasets", "pictures", "ros", "algorithms", "errors"},
    "datasets": {
        *{"datasets", "rendering", "formats", "cache", "algorithms", "errors"},
        *{"messages", "recording", "trajectory"},  # our own recordings are a source, too
        *{"ros", "bus"},  # a live camera of ROS is reached over Zenoh
    },
    "results": {
        *{"results", "formats", "pictures", "recording", "messages", "algorithms", "errors"},
        *{"config", "files", "staging", "map_history", "trajectory", "datasets", "arithmetic"},
    },
    "offline": {"datasets", "messages", "algorithms", "config", "map_history"},
    "backwards": {"datasets", "messages", "algorithms", "config", "map_history", "errors"},
    "fusion": {"fusion", "algorithms", "errors", "map_history"},
}
# They import nothing of ours; ``pliant`` is of the top.
ANYWHERE = {"exit_codes", "programs", "text_files", "version", "wording", "yaml_text"}
PURE_FORBIDS = {"time", "datetime", "socket", "logging", "os", "pathlib", "random", "threading"}


@cache
def nodes(path: Path) -> list[ast.AST]:
    """What several rules look for is read once."""
    kinds = (ast.Import, ast.ImportFrom, ast.Call)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(tree) if isinstance(node, kinds)]


def imports(path: Path) -> Iterator[str]:
    for node in nodes(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield node.module or ""


def python_files(folder: Path) -> list[Path]:
    files = sorted(folder.rglob("*.py"))
    assert files, f"no files in {folder}"
    return files


def test_imports_go_one_way() -> None:
    breaches: list[str] = []
    for path in python_files(LIBRARY):
        room = path.relative_to(LIBRARY).parts[0].removesuffix(".py")
        for name in imports(path):
            own = f"{name}.".startswith("pliant.") and room in MAY_IMPORT
            allowed = not own or name.partition(".")[2].split(".")[0] in MAY_IMPORT[room] | ANYWHERE
            if name.startswith("pliant_services") or not allowed:
                breaches.append(f"{path.relative_to(ROOT)} imports {name}")
    assert not breaches


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Also not inside their functions."""
    paths = {
        ".".join(path.relative_to(root.parent).with_suffix("").parts).removesuffix(
            ".__init__"
        ): path
        for root in (LIBRARY, SERVICES)
        for path in python_files(root)
    }
    below: dict[str, set[str]] = {}
    for name, path in paths.items():
        below[name] = set(imports(path)) - {"pliant"}
        for node in nodes(path):
            if isinstance(node, ast.ImportFrom):
                below[name] |= {f"{node.module}.{alias.name}" for alias in node.names}
                if all(f"{node.module}.{alias.name}" in paths for alias in node.names):
                    below[name].discard(str(node.module))  # only modules inside the package
    while free := [name for name, found in below.items() if not found & below.keys()]:
        for name in free:
            del below[name]
    assert not below


SLAM_LAYERS = (
    *("estimate", "parameters", "keyframe_rule", "map", "calibration", "locate", "frame"),
    *("adjust", "start", "places", "store", "active", "journal", "atlas"),
    *("frame_mapper", "mapper", "localiser", "calibration_bootstrap"),
)
"""Of ``algorithms/slam``: each imports only those before it."""


def test_packages_of_slam_import_those_below_them() -> None:
    slam = LIBRARY / "algorithms" / "slam"
    breaches: list[str] = []
    for path in python_files(slam):
        room = path.relative_to(slam).parts[0].removesuffix(".py")
        if room == "__init__":
            continue
        below = SLAM_LAYERS[: SLAM_LAYERS.index(room) + 1]
        for name in imports(path):
            package = name.removeprefix("pliant.algorithms.slam.")
            if package != name and package.split(".")[0] not in below:
                breaches.append(f"{path.relative_to(slam)} imports {name}")
    assert not breaches


def test_algorithms_are_pure() -> None:
    breaches: list[str] = []
    for path in python_files(LIBRARY / "algorithms") + python_files(LIBRARY / "rendering"):
        used = PURE_FORBIDS & {name.split(".")[0] for name in imports(path)}
        calls = {
            node.func.id
            for node in nodes(path)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        used |= calls & {"open", "print", "input"}
        breaches += [f"{path.relative_to(ROOT)} uses {name}" for name in sorted(used)]
    assert not breaches


def test_landmarks_alone_write_their_positions() -> None:
    writes = re.compile(r"points\.(xyz|spread)\[[^\n]*\] = ")
    slam = LIBRARY / "algorithms" / "slam"
    texts = {path.name: path.read_text(encoding="utf-8") for path in python_files(slam)}
    assert [name for name, text in texts.items() if writes.search(text)] == []


def test_open3d_is_loaded_by_one_module() -> None:
    """Which says what to install where a library of the system is missing."""
    loaded_by = [
        str(path.relative_to(ROOT))
        for path in python_files(LIBRARY) + python_files(SERVICES)
        if "open3d" in {name.split(".")[0] for name in imports(path)}
        or re.search(r"""import_module\(["']open3d""", path.read_text(encoding="utf-8"))
    ]
    assert loaded_by == ["shared/pliant/open3d_library.py"]


def test_no_module_loads_open3d_when_it_is_imported() -> None:
    """A second and 200 MB for each command and service, and on a bare machine an error."""
    code = (
        "import importlib, pkgutil, sys\n"
        "import pliant, pliant_services\n"
        "for package in (pliant, pliant_services):\n"
        "    for found in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not found.name.endswith('__main__'): importlib.import_module(found.name)\n"
        "        if 'open3d' in sys.modules: sys.exit(f'{found.name} loads open3d')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_file_names_a_machine() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    machine_path = re.compile(r"(?<![\w.])/(root|home|work|Users)/\w")
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in {".py", ".md", ".toml", ".yaml", ".txt", ".cfg", ""} and path.is_file():
            text = path.read_text(encoding="utf-8", errors="replace")
            assert not machine_path.search(text), f"{name} names a path of one machine"


CALLS_NO_KERNEL = (
    "pliant_services.cli.commands",  # the first: without numpy, too
    "pliant.config",
    "pliant.datasets.builtin",
    "pliant_services.cli.router",
    "pliant_services.nodes.ingest",
    "pliant_services.nodes.recorder",
    "pliant_services.runtime.host",
    "pliant_services.runtime.session_end",
    "pliant_services.runtime.status",
    "pliant_services.run.command",
)


def test_what_calls_no_kernel_loads_none() -> None:
    """All in one process, which names the first that does."""
    code = (
        "import importlib, sys\n"
        "for name in sys.argv[1:]:\n"
        "    importlib.import_module(name)\n"
        "    if 'numba' in sys.modules: sys.exit(f'{name} loads kernels')\n"
        "    if name.endswith('commands') and 'numpy' in sys.modules: sys.exit(f'{name}: numpy')"
    )
    command = [sys.executable, "-c", code, *CALLS_NO_KERNEL]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


HEAVY = {
    *("cv2", "matplotlib", "numba", "open3d", "scipy"),
    *("pliant.datasets", "pliant.formats", "pliant.map_history", "pliant.pictures"),
}
COMMANDS = {
    "--help": {*HEAVY, "numpy", "zenoh"},
    "router --listen nowhere": {*HEAVY, "pliant.config", "pliant.state"},
    "status --connect nowhere": {*HEAVY, "pliant.config", "pliant.state"},
    "stop --connect nowhere": {*HEAVY, "pliant.config", "pliant.state"},
    "service recorder --connect nowhere --output x.mcap": HEAVY,
}
"""Commands, and what their processes may not load.  Nowhere is no endpoint: when they say so they
have imported all that they work with."""


def test_processes_that_wait_and_write_load_nothing_heavy(tmp_path: Path) -> None:
    """All in one process, which names the first that does."""
    code = (
        "import json, sys\n"
        "from pliant_services.cli import main\n"
        "for command, heavy in json.loads(sys.argv[1]):\n"
        "    sys.argv = ['pliant', *command.split()]\n"
        "    try: main()\n"
        "    except SystemExit as end: code = end.code\n"
        "    assert code == ('nowhere' in command), f'{command}: {code}'\n"
        "    loaded = sorted(set(heavy) & set(sys.modules))\n"
        "    assert not loaded, f'{command} loads {loaded}'\n"
        "assert 'pliant_services.nodes.recorder' in sys.modules"
    )
    cases = json.dumps([(command, sorted(heavy)) for command, heavy in COMMANDS.items()])
    command = [sys.executable, "-c", code, cases]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("nowhere: not an endpoint") == len(COMMANDS) - 1


def test_no_two_test_files_have_one_name() -> None:
    """Pytest collects only the first of them, beside the other's folder."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted({name for name in names if names.count(name) > 1}) == []


ONE_MEANING = {
    *{"__init__", "base", "command", "parameters"},  # of its room
    *{"colmap", "euroc", "kitti", "textured"},  # formats, read, written and made
    *{"calibration", "depth", "folder", "images", "masks", "run", "surfels"},
}
"""Names of modules that several rooms have: each does its part with the same thing."""


def test_no_two_modules_have_one_name_with_two_meanings() -> None:
    """A command's file is named like what it starts."""
    command_line = SERVICES / "cli"
    files = python_files(LIBRARY) + python_files(SERVICES)
    names = [path.stem for path in files if path.parent != command_line]
    assert {name for name in names if names.count(name) > 1} <= ONE_MEANING


def test_no_test_imports_another() -> None:
    """What tests share is in a module of its own."""
    for path in sorted((ROOT / "tests").rglob("*.py")):
        found = re.findall(r"^(?:from|import) (test_\w+)", path.read_text("utf-8"), re.MULTILINE)
        assert not found, path
