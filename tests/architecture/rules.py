"""The import rules as tables, and a checker that reads source files without running them.

Modules are named by where they lie in the checkout: `lerobot_cqn.critic`, `train.envs.station`. The installed
names (`cqn_train`, `cqn_data`, `lerobot_policy_cqn`) are translated back to these.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOMS = ("lerobot_cqn", "datasets_tools", "train")
INSTALLED_AS = {
    "cqn_train": "train",
    "cqn_data": "datasets_tools",
    "lerobot_policy_cqn": "lerobot_cqn._plugin",
}

# --- Which room may use which other one: prefixes of module names.
ROOM_MAY_USE: dict[str, tuple[str, ...]] = {
    "lerobot_cqn": (),
    "lerobot_cqn._plugin": ("train.envs", "train.sim_arm"),
    "datasets_tools": tuple(
        f"lerobot_cqn.{name}"
        for name in [
            "errors",
            "ranges",
            "schema",
            "delta_actions",
            "hub_retry",
            "history_text",
            "scaling_check",
            "rows_check",
        ]
    ),
    "train": ("lerobot_cqn", "datasets_tools"),
}

# --- Floors of each room, lowest first: a folder, or a file beside folders, uses only itself and those on floors before
# it; those that share a floor (|) do not know one another. Imports that run later, or only for the type checker, count
# as well: whoever reads the code follows them all the same.
FLOORS: dict[str, str] = {
    # tensors in, tensors out, never a configuration (up to losses); then networks; then what LeRobot sees
    "lerobot_cqn": (
        "errors schema|ranges discretisation|distributional|augmentation|n_step losses settings networks model "
        "critic|actor_critic|learner sequence delta_actions|scaling_check "
        "rows_check|joint_goals|fit_pictures|history_text|hub_retry|correction base_config model_card|processors "
        "base_policy "
        "configuration_cqn|configuration_drqv2 configuration_cqn_as "
        "processor_cqn|processor_cqn_as|processor_drqv2 modeling_cqn|modeling_cqn_as|modeling_drqv2"
    ),
    "datasets_tools": (
        "terminal decisions|web views disk hub operations formats|inspection|review human_hand record|cli"
    ),
    "train": (
        "interfaces|clock envs|robot|operator sim_arm|config agent replay run loop arm "
        "push|arguments|virtual_so101 build execute cluster cli|bench|demo"
    ),
}

# --- Packages of the extras: imported on use, so that everything else works without them.
OPTIONAL = frozenset(
    {
        "mujoco", "matplotlib", "wandb", "tensorboard", "fastapi", "uvicorn", "h5py", "zarr", "rliable", "metaworld",
        "dm_control", "cryptography", "gym_hil", "gym_pusht", "gym_aloha", "rlbench", "pyrep", "ray",
    }
)  # fmt: skip
# Modules that need one at their top; they in turn are imported only inside functions or by one another.
IMPORTED_ON_USE = frozenset[str]()

# --- Limits and forbidden calls.
MAX_LINES = 400
FORBIDDEN_CALLS = {"eval", "exec", "pickle.load", "pickle.loads", "pickle.Unpickler", "os.system"}
FORBIDDEN_ARGUMENTS = {"shell": True, "weights_only": False, "allow_pickle": True}


@dataclass(frozen=True)
class Import:
    """One imported name: `name` may be a module or an object in one."""

    name: str
    line: int
    at_top: bool  # runs when the file is imported
    relative: bool


@dataclass
class Source:
    """One parsed file."""

    path: Path
    module: str
    text: str
    imports: list[Import] = field(default_factory=list)
    tree: ast.Module = field(default_factory=lambda: ast.Module(body=[], type_ignores=[]))

    @property
    def room(self) -> str:
        """The longest entry of ROOM_MAY_USE that this module lies in."""
        return max((room for room in ROOM_MAY_USE if within(self.module, room)), key=len)


def within(name: str, prefix: str) -> bool:
    """Whether `name` is `prefix` or lies under it."""
    return name == prefix or name.startswith(prefix + ".")


def module_name(path: Path, root: Path) -> str:
    """`train/envs/__init__.py` -> `train.envs`."""
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _resolve(node: ast.ImportFrom, source: Source) -> str:
    """The absolute name a `from` refers to, translated to where it lies in the checkout."""
    if not node.level:
        return _as_in_checkout(node.module or "")
    package = source.module.split(".")
    if source.path.name != "__init__.py":
        package = package[:-1]
    package = package[: len(package) - node.level + 1]
    return ".".join([*package, *([node.module] if node.module else [])])


def _as_in_checkout(name: str) -> str:
    head, _, rest = name.partition(".")
    head = INSTALLED_AS.get(head, head)
    return f"{head}.{rest}" if rest else head


def _imports(node: ast.AST, source: Source, at_top: bool = True) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            for alias in child.names:
                yield Import(_as_in_checkout(alias.name), child.lineno, at_top, relative=False)
        elif isinstance(child, ast.ImportFrom):
            base = _resolve(child, source)
            for alias in child.names:
                yield Import(f"{base}.{alias.name}", child.lineno, at_top, relative=bool(child.level))
        else:
            later = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
            later = later or (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test))
            yield from _imports(child, source, at_top and not later)


def read(path: Path, root: Path) -> Source:
    """Parse one file and collect its imports."""
    text = path.read_text(encoding="utf-8")
    source = Source(path, module_name(path, root), text, tree=ast.parse(text, str(path)))
    source.imports = list(_imports(source.tree, source))
    return source


def read_rooms(root: Path) -> list[Source]:
    """All files of the three packages."""
    return [read(path, root) for room in ROOMS for path in sorted((root / room).rglob("*.py"))]


def check_rooms(source: Source) -> Iterator[str]:
    """Rooms use only the rooms they may; `train` is used by nobody."""
    own_room = source.module.split(".")[0]
    for item in source.imports:
        room = item.name.split(".")[0]
        if room in ROOMS and room != own_room and not _allowed(item.name, ROOM_MAY_USE[source.room]):
            may = ", ".join(ROOM_MAY_USE[source.room]) or "no other room"
            yield f"{_at(source, item)} imports {item.name}; {source.room} may use {may}"
        if source.room != "lerobot_cqn._plugin" and within(item.name, "lerobot_cqn._plugin"):
            yield f"{_at(source, item)} imports {item.name}; the plugin is the outermost layer"


def _allowed(name: str, prefixes: tuple[str, ...]) -> bool:
    return any(within(name, prefix) for prefix in prefixes)


def check_relative(source: Source) -> Iterator[str]:
    """`train` and `datasets_tools` are installed under other names, so they name themselves relatively."""
    own_room = source.module.split(".")[0]
    for item in source.imports:
        if own_room != "lerobot_cqn" and within(item.name, own_room) and not item.relative:
            yield f"{_at(source, item)} imports {item.name} absolutely; write it relative"


def check_installed_names(source: Source) -> Iterator[str]:
    """Elsewhere the installed names are used: `import train` finds any train.py that is on the path."""
    for node in ast.walk(source.tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        if isinstance(node, ast.ImportFrom) and not node.level:
            names = [node.module or ""]
        for name in names:
            if name.split(".")[0] in ("train", "datasets_tools"):
                yield f"{source.path}:{node.lineno} imports {name}; write cqn_train or cqn_data"


def check_floors(source: Source) -> Iterator[str]:
    """Within a room imports go down only."""
    room, _, rest = source.module.partition(".")
    own = rest.partition(".")[0]
    if own in ("", "_plugin"):  # a room's __init__ names what it offers; the plugin is a room of its own
        return
    floors = [floor.split("|") for floor in FLOORS[room].split()]
    number = next((i for i, floor in enumerate(floors) if own in floor), None)
    if number is None:
        yield f"{source.path}:1 is on no floor of {room}: enter it in FLOORS of tests/architecture/rules.py"
        return
    may = {own}.union(*floors[:number])
    for item in source.imports:
        if within(item.name, room) and item.name[len(room) + 1 :].partition(".")[0] not in may:
            yield f"{_at(source, item)} imports {item.name or room}; {own} may use {', '.join(sorted(may))}"


def circles(sources: list[Source]) -> list[list[str]]:
    """Groups of modules that import one another, whenever these imports run."""
    modules = {source.module for source in sources}
    uses: dict[str, set[str]] = {source.module: set() for source in sources}
    for source in sources:
        for item in source.imports:
            name = item.name
            while name and name not in modules:
                name = name.rpartition(".")[0]
            uses[source.module] |= {name} - {"", source.module}
    reached = {module: _reached(module, uses) for module in uses}
    groups = {frozenset(other for other in reached[m] if m in reached[other]) for m in reached if m in reached[m]}
    return sorted(sorted(group) for group in groups)


def _reached(module: str, uses: dict[str, set[str]]) -> set[str]:
    found: set[str] = set()
    waiting = [module]
    while waiting:
        new = uses[waiting.pop()] - found
        found |= new
        waiting += new
    return found


def check_optional(source: Source) -> Iterator[str]:
    """Packages of the extras, and the files that need them, are imported on use."""
    if source.module in IMPORTED_ON_USE:
        return
    for item in source.imports:
        if not item.at_top:
            continue
        if item.name.split(".")[0] in OPTIONAL:
            yield f"{_at(source, item)} imports {item.name} at its top; import it on use"
        if _allowed(item.name, tuple(IMPORTED_ON_USE)):
            yield f"{_at(source, item)} imports {item.name} at its top; it needs an extra: import it on use"


def check_forbidden(source: Source) -> Iterator[str]:
    """No code from data: eval, exec, pickle, shells."""
    for node in ast.walk(source.tree):
        if not isinstance(node, ast.Call):
            continue
        name = ast.unparse(node.func)
        if name in FORBIDDEN_CALLS:
            yield f"{source.path}:{node.lineno} calls {name}"
        for keyword in node.keywords:
            value = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
            if keyword.arg in FORBIDDEN_ARGUMENTS and value is FORBIDDEN_ARGUMENTS[keyword.arg]:
                yield f"{source.path}:{node.lineno} passes {keyword.arg}={value}"


def check_length(source: Source) -> Iterator[str]:
    """Files stay short enough to be read in one go."""
    lines = len(source.text.splitlines())
    if lines > MAX_LINES:
        yield f"{source.path}:{lines} has {lines} lines, more than {MAX_LINES}: split it by responsibility"


def _at(source: Source, item: Import) -> str:
    return f"{source.path}:{item.line} {source.module}"


ROOM_CHECKS = (
    check_rooms,
    check_relative,
    check_floors,
    check_optional,
)
EVERYWHERE_CHECKS = (check_installed_names, check_forbidden, check_length)
