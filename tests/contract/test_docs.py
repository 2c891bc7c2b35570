"""The documentation: links lead somewhere, commands parse as they are printed, the reference is that of the code."""

import importlib
import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lerobot.policies.factory  # noqa: F401  # registers the policies that lerobot-train knows
import pytest
import yaml
from lerobot.configs import parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.utils.import_utils import register_third_party_plugins

from cqn_data.operations.job import Job
from cqn_data.operations.recipe import load_recipe
from cqn_data.operations.registry import OPERATIONS, STEPS, module_of, step_class
from cqn_data.terminal.options import parse, parse_all
from cqn_train import arguments as cqn_train
from cqn_train.arm.devices import register_devices
from cqn_train.bench import cli as bench
from cqn_train.push.config import PushConfig
from lerobot_cqn.configuration_cqn import CQNConfig
from lerobot_cqn.errors import CQNError

from .documents import PAGES, ROOT, Command, anchors, commands, links, listings

# LeRobot's commands: the module and the class of their options; None where they have none that are parsed.
LEROBOT: dict[str, tuple[str, str] | None] = {
    "lerobot-train": ("lerobot.configs.train", "TrainPipelineConfig"),
    "lerobot-eval": ("lerobot.configs.eval", "EvalPipelineConfig"),
    "lerobot-record": ("lerobot.scripts.lerobot_record", "RecordConfig"),
    "lerobot-teleoperate": ("lerobot.scripts.lerobot_teleoperate", "TeleoperateConfig"),
    "lerobot-calibrate": ("lerobot.scripts.lerobot_calibrate", "CalibrateConfig"),
    "lerobot-setup-motors": ("lerobot.scripts.lerobot_setup_motors", "SetupConfig"),
    "lerobot-rollout": ("lerobot.rollout", "RolloutConfig"),
    "lerobot-find-port": None,
    "lerobot-find-cameras": None,
}
SLOW_SITE_S = 120


# -- links -------------------------------------------------------------------------------------------------------


def broken(page: Path, text: str) -> list[str]:
    """Links of a page that lead nowhere, with their lines."""
    problems = []
    for line, target in links(text):
        path, _, anchor = target.partition("#")
        if re.match(r"[a-z]+:", target):
            continue
        goal = (page.parent / path).resolve() if path else page
        if not goal.exists() or not goal.is_relative_to(ROOT):
            problems.append(f"{page.relative_to(ROOT)}:{line}: no file {target}")
        elif anchor and anchor not in anchors(text if not path else goal.read_text(encoding="utf-8")):
            problems.append(f"{page.relative_to(ROOT)}:{line}: no heading {target}")
    return problems


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    assert broken(page, page.read_text(encoding="utf-8")) == []


def test_a_broken_link_would_be_found() -> None:
    text = (
        "# A heading\n\n[x](docs/none.md) [y](#a-heading) [z](#b) ![p](docs/images/none.png)\n```\n[not](here)\n```\n"
    )
    assert [problem.rpartition(" ")[2] for problem in broken(ROOT / "README.md", text)] == [
        "docs/none.md", "#b", "docs/images/none.png",
    ]  # fmt: skip


# -- the reference and the site ----------------------------------------------------------------------------------


def load(path: Path) -> Any:
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_the_reference_is_that_of_the_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reference = load(ROOT / "docs" / "reference.py")
    assert reference.main(["--check"]) == 0, "run: python docs/reference.py"
    old = tmp_path / "configuration.md"
    old.write_text(reference.TARGET.read_text(encoding="utf-8").replace("`--offline_updates`", "`--offline`"))
    monkeypatch.setattr(reference, "TARGET", old)
    assert reference.main(["--check"]) == 1
    assert reference.main([]) == 0
    assert reference.main(["--check"]) == 0


def test_the_site_is_built_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="needs the extra [docs]")
    site = tmp_path / "site"
    build = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-c", "docs", "-d", str(tmp_path / "trees")]
    done = subprocess.run(
        [*build, ".", str(site)], cwd=ROOT, capture_output=True, text=True, timeout=SLOW_SITE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    front = (site / "index.html").read_text(encoding="utf-8")
    for page in PAGES:  # each is in the sidebar
        assert f'href="{page.relative_to(ROOT).with_suffix(".html")}"' in front or page.name == "README.md", page


# -- commands ----------------------------------------------------------------------------------------------------


def check_cqn_train(options: Sequence[str]) -> None:
    """Parse and validate; what a checkpoint would say is taken from the defaults."""
    given = [option for option in options if not option.startswith(("--resume", "--policy.path", "--debug"))]
    if len(given) < len(options):
        given = ["--policy.type=cqn", *given]
        if not any(option.startswith(("--env.type", "--robot.type")) for option in given):
            given.append("--env.type=ur5e_station")
        given.append("--dataset.repo_id=local/x")
    cqn_train.parse(given).validate()


def check_cqn_data(words: Sequence[str]) -> None:
    """Parse with the operation's own options and validate them."""
    operation, *options = words
    assert operation in OPERATIONS, operation
    module = module_of(operation)
    if operation == "run":
        recipe, *options = options
        steps = [
            option for option in options if option[2:].partition(".")[0] in STEPS and "." in option.partition("=")[0]
        ]
        (job,) = parse_all((Job,), [option for option in options if option not in steps])
        parsed = [job, *load_recipe(recipe, steps)]
    elif operation in STEPS:
        parsed = list(parse_all((Job, step_class(operation)), options))
    else:
        (kind,) = [kind for name, kind in vars(module).items() if name == f"{operation.title()}Config"]
        rename = getattr(module, "_python_name", str)
        parsed = list(parse_all((kind,), [rename(option) for option in options if not option.startswith("--env.")]))
        settings = [option for option in options if option.startswith("--env.")]
        if settings:
            assert operation == "record"
            parsed.append(module.env_config(settings))
    for config in parsed:
        getattr(config, "validate", lambda: None)()


def check_cqn_bench(words: Sequence[str]) -> None:
    """The plan is there, its methods parse on its tasks, and the options are known."""
    plan, *options = words
    assert dict(bench._options(options))["output_dir"]
    bench.check(bench.runs_of(bench.load_plan(ROOT / plan), Path("outputs/x"))[:1])  # the command itself checks all


def check_lerobot(name: str, options: Sequence[str], patch: pytest.MonkeyPatch) -> None:
    """Parse as the command does; a policy that would be loaded is a new one."""
    place = LEROBOT[name]
    if place is None:
        return
    if any(option.startswith(("--robot.", "--teleop.")) for option in options):
        register_devices()
    kind = getattr(importlib.import_module(place[0]), place[1])

    def take(config: Any) -> Any:
        return config

    take.__annotations__ = {"config": kind}
    patch.setattr(sys, "argv", [name, *options])
    patch.setattr(PreTrainedConfig, "from_pretrained", lambda *_, **__: CQNConfig(device="cpu"))
    config = parser.wrap()(take)()
    if name == "lerobot-train":
        config.validate()


def complaint(command: Command, patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> str:
    """What is wrong with a command of ours or LeRobot's; "" for nothing."""
    name, *words = command.words
    try:
        if name == "cqn-train":
            check_cqn_train(words)
        elif name == "cqn-data":
            check_cqn_data(words)
        elif name == "cqn-bench":
            check_cqn_bench(words)
        elif name == "cqn-push":
            parse(PushConfig, words).validate()
        elif name.startswith("lerobot-"):
            check_lerobot(name, words, patch)
    except SystemExit:
        return f"{command}: {capsys.readouterr().err.strip()[-300:]}"
    except (CQNError, ValueError, AssertionError, KeyError, FileExistsError) as error:
        return f"{command}: {type(error).__name__} {error}"
    return ""


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to be in, with the recipe that the pages show, and all plugins known."""
    register_third_party_plugins()
    recipes = [item for page in PAGES for item in listings(page) if item.language == "yaml" and "steps:" in item.text]
    (tmp_path / "my_recipe.yaml").write_text(recipes[0].text)
    monkeypatch.chdir(tmp_path)
    return tmp_path


WRONG: list[tuple[str, Callable[[str], bool]]] = [
    ("cqn-train --policy.type=cqn --env.type=ur5e_station --output_dir=x --offline=3", lambda s: "--offline" in s),
    ("cqn-train --policy.type=cqn --env.type=ur5e_station --output_dir=x", lambda s: "No demonstrations" in s),
    ("cqn-train --policy.type=cqn --policy.preset=laptop --env.type=ur5e_station", lambda s: "laptop_state" in s),
    ("cqn-data filter --repo_id=a/b --treshold=1", lambda s: "--threshold" in s),
    ("cqn-data run my_recipe.yaml --repo_id=a/b --filter.treshold=1", lambda s: "threshold" in s),
    ("cqn-data record --env.type=ur5e_station --repo_id=a/b --env.task=clik", lambda s: "click_button" in s),
    ("cqn-bench benchmarks/none.yaml --output_dir=x", lambda s: "No plan" in s),
    ("cqn-push --run=outputs/click --repo=user/click", lambda s: "--repo_id" in s),
    ("lerobot-train --policy.type=act --dataset.repo_id=a/b --output_dir=x", lambda s: "repo_id" in s),
    ("lerobot-eval --env.type=ur5e_station --eval.episodes=5", lambda s: "--eval.episodes" in s),
]


@pytest.mark.parametrize(("words", "says"), WRONG, ids=lambda value: value if isinstance(value, str) else "")
def test_a_wrong_command_would_be_found(
    words: str, says: Callable[[str], bool], desk: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    assert says(complaint(Command("x.md", 1, tuple(words.split())), monkeypatch, capsys))


# Once LeRobot's devices are known, every parser of the process takes seconds: the page that needs them comes last.
@pytest.mark.parametrize(
    "page",  # those of docs/extending.md run in test_docs_listings.py, where their package is
    sorted((p for p in PAGES if p.name != "extending.md"), key=lambda page: page.name == "real_arm.md"),
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_commands_parse(
    page: Path, desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    problems = []
    for command in commands(page, desk):
        with monkeypatch.context() as patch:
            problems.append(complaint(command, patch, capsys))
    assert [problem for problem in problems if problem] == []


def test_the_pages_have_commands_of_every_kind(tmp_path: Path) -> None:
    found = {command.words[0] for page in PAGES for command in commands(page, tmp_path)}
    assert {"cqn-train", "cqn-data", "cqn-bench"} < found
    assert {name for name in found if name.startswith("lerobot-")} <= LEROBOT.keys()
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    for page in PAGES:
        for command in commands(page, tmp_path):
            if command.words[0] == "make":
                assert {word for word in command.words[1:] if "=" not in word} <= targets, command


def test_listings_of_yaml_are_yaml() -> None:
    for page in PAGES:
        for listing in listings(page):
            if listing.language == "yaml":
                assert yaml.safe_load(listing.text), f"{page}:{listing.line}"


# -- messages ----------------------------------------------------------------------------------------------------

# Python, LeRobot, and what `one_of` puts together from two places.
OTHERS_SAY = {
    "invalid choice: 'cqn'",
    "'torchcodec' is installed but cannot be loaded",
    "Unknown camera of the robot '…'",
}


def said() -> str:
    """All texts of the code, parts put together, each value in them as "…"."""
    sources = [path for room in ("train", "datasets_tools", "lerobot_cqn") for path in (ROOT / room).rglob("*.py")]
    text = "\n".join(path.read_text(encoding="utf-8") for path in [*sources, ROOT / ".ci" / "setup.sh"])
    text = re.sub(r'"\s*\n?\s*f?"', "", text)
    return re.sub(r"\{[^{}]*\}|%s", "…", text)


def quoted(page: Path) -> list[str]:
    """Messages in the first column of a page's tables."""
    rows = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    found = [phrase for row in rows for phrase in re.findall(r"`([^`]+)`", row.split(" | ")[0])]
    return [phrase for phrase in found if " " in phrase]


def test_troubleshooting_quotes_what_the_code_says() -> None:
    text, phrases = said(), quoted(ROOT / "docs" / "troubleshooting.md")
    assert len(phrases) > 20
    unknown = []
    for phrase in phrases:
        plain = phrase.removeprefix("Warning: ")
        pattern = ".{0,60}?".join(re.escape(part) for part in plain.replace("...", "…").split("…"))
        if phrase not in OTHERS_SAY and not re.search(pattern, text):
            unknown.append(phrase)
    assert unknown == []
