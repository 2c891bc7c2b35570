"""Facts for the policy's card, and the files that go to the Hub, read from a run's folder."""

import contextlib
import dataclasses
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.robots.config import RobotConfig
from lerobot.teleoperators.config import TeleoperatorConfig
from lerobot.utils.constants import ACTION

from cqn_data.hub.files import Content
from cqn_data.terminal.console import note
from lerobot_cqn.base_config import RLConfig
from lerobot_cqn.errors import CQNError, DataError
from lerobot_cqn.model_card import DataFacts, Evaluated, ModelFacts, action_kind, commands, data_facts

from ..agent import Agent
from ..config import DatasetSettings
from ..replay.demonstrations import load_metadata
from ..run.metrics import COLUMNS, read_rows

__all__ = ["Found", "find_checkpoint", "look"]

TABLES = ("evaluations", "episodes", "updates")
CURVE, DATASET_CARD = "training/curve.png", "training/dataset_card.md"
# Settings of a machine: they say nothing to others, and may name people and folders.
PRIVATE = {("output_dir",), ("dataset", "root"), ("policy", "pretrained_path"), ("policy", "repo_id"), ("resume",),
           ("policy", "push_to_hub"), ("checkpoint_path",), ("job_name",), ("robot", "person")}  # fmt: skip
RECIPE = (
    "updates_per_step",
    "update_interval",
    "updates_per_episode",
    "async_updates",
    "batch_size",
    "demo_batch_size",
    "relabel",
)


@dataclass(frozen=True)
class Found:
    """A checkpoint: its `pretrained_model` folder, and the run it belongs to, None where it stands alone."""

    model: Path
    run: Path | None

    @property
    def step(self) -> int | None:
        """Environment step of a run of cqn-train, update of one of lerobot-train; None where nothing says it."""
        name = self.model.resolve().parent.name
        return int(name) if name.isdigit() else None

    @property
    def settings(self) -> dict[str, Any]:
        """train_config.json; empty where there is none. Raises DataError where it is damaged."""
        return _json(self.model / "train_config.json")


def find_checkpoint(run: Path, checkpoint: str) -> Found:
    """The checkpoint of a run, or the one that `run` itself is. Raises DataError when there is none."""
    if (run / "config.json").is_file():
        folders = run.resolve().parents
        inside = len(folders) > 2 and folders[1].name == "checkpoints"
        return Found(run, folders[2] if inside else None)
    folder = run / "checkpoints"
    there = sorted(p.name for p in folder.iterdir() if (p / "pretrained_model").is_dir()) if folder.is_dir() else []
    if checkpoint not in there:
        digits = [name for name in there if name.isdigit() and checkpoint.isdigit() and int(name) == int(checkpoint)]
        if not digits:
            known = f"it has {', '.join(there)}" if there else "it has none"
            raise DataError(
                f"No checkpoint '{checkpoint}' in {run}: {known}; give the --output_dir of a run (and --checkpoint for "
                "an earlier one), or a `pretrained_model` folder."
            )
        checkpoint = digits[0]
    return Found(folder / checkpoint / "pretrained_model", run)


def look(
    found: Found, repo_id: str, *, films: int, license: str | None, tags: tuple[str, ...], dataset: str | None = None
) -> tuple[ModelFacts, dict[str, Content]]:
    """Facts of the card, and path in the repository -> content, without the card itself.

    dataset: its name on the Hub, where it is another one than in the run. The weights are loaded once, so that nothing
    is pushed which nobody can load.
    Raises DataError where the checkpoint is damaged or another policy's.
    """
    config, actions = _load(found.model)
    settings = found.settings
    files: dict[str, Content] = {
        path.name: path
        for path in sorted(found.model.iterdir())
        if path.suffix in (".safetensors", ".json") and path.name not in ("train_config.json", "config.json")
    }
    files["config.json"] = _text(_without(_json(found.model / "config.json"), {("pretrained_path",), ("repo_id",)}))
    if settings:
        files["train_config.json"] = _text(_without(settings, PRIVATE))
    data = _data(settings, actions, files)
    if data is not None and dataset:
        data = dataclasses.replace(data, repo_id=dataset, public=True)
    env, robot, teleop = (
        _decoded(kind, settings.get(name))
        for name, kind in (("env", EnvConfig), ("robot", RobotConfig), ("teleop", TeleoperatorConfig))
    )
    more = [f"--{name}={str(value).lower()}" for name, value in _schedule(settings).items()]
    if data is not None and not data.public:
        more.append("--dataset.root=...")
    results, described = _results(found, films, files)
    return ModelFacts(
        repo_id=repo_id,
        config=config,
        task=_task(env, robot, data),
        training=_training(found, settings),
        commands=commands(
            repo_id, env=env, robot=robot, teleop=teleop, dataset=data.repo_id if data is not None else "",
            fps=(settings.get("arm") or {}).get("fps") or (data.fps if data is not None else None), more=more,
        ),
        license=license,
        tags=tags,
        data=data,
        results=results,
        origin=_origin(settings),
        curve=CURVE if CURVE in files else None,
        films=[path for path in files if path.endswith(".mp4")],
        files=described | ({DATASET_CARD: "what the demonstrations are"} if DATASET_CARD in files else {}),
    ), files  # fmt: skip


def _load(model: Path) -> tuple[RLConfig, list[tuple[str, str, str, str]]]:
    """The configuration, and the actions as the processors scale them; all parts are loaded on the way."""
    try:
        config: Any = PreTrainedConfig.from_pretrained(model)
        if not isinstance(config, RLConfig):
            raise DataError(f"{model} holds a policy of type '{config.type}': push it with LeRobot.")
        config.device = "cpu"
        with contextlib.redirect_stdout(io.StringIO()):  # it says where it loads from
            policy: Any = get_policy_class(config.type).from_pretrained(model, config=config)
        agent = Agent(policy, *make_pre_post_processors(config, pretrained_path=str(model)))
    except CQNError:
        raise
    except Exception as error:  # draccus, safetensors and torch raise kinds of their own
        said = " ".join(str(error).split())[:200]
        raise DataError(f"The checkpoint in {model} cannot be loaded, so it is not pushed: {said}") from error
    bounds, deltas = agent.ranges(ACTION), () if agent.deltas is None else agent.deltas.action_dims
    if bounds is None:
        return config, []
    kinds = [action_kind(i in deltas, any_changed=bool(deltas)) for i in range(bounds.shape[1])]
    return config, [
        (str(i), kind, f"{low:.4g}", f"{high:.4g}")
        for i, (kind, low, high) in enumerate(zip(kinds, *bounds, strict=True))
    ]


def _data(
    settings: Mapping[str, Any], actions: list[tuple[str, str, str, str]], files: dict[str, Content]
) -> DataFacts | None:
    """The demonstrations, as far as they can still be read; their card becomes one of the files."""
    given = settings.get("dataset") or {}
    name = given.get("repo_id")
    if not name:
        return None
    chosen = DatasetSettings(str(name), given.get("root"), given.get("episodes"))
    try:
        facts = data_facts(load_metadata(chosen), chosen.repo_id, chosen.episodes, public=chosen.root is None)
        files[DATASET_CARD] = _dataset_card(chosen).encode()
    except Exception as error:  # a dataset that is gone must not keep its policy from the Hub
        note(f"The card tells less of the demonstrations: {' '.join(str(error).split())[:200]}")
        return DataFacts(chosen.repo_id, actions=actions, public=chosen.root is None)
    named = [(known[0], *row[1:]) for known, row in zip(facts.actions, actions, strict=False)]
    return dataclasses.replace(facts, actions=named or actions)


def _dataset_card(chosen: DatasetSettings) -> str:
    from cqn_data.disk.source import open_source
    from cqn_data.hub.card import Labels, write_card
    from cqn_data.hub.card import look as look_at_dataset

    facts = look_at_dataset(open_source(chosen.repo_id, chosen.root))
    card: str = write_card(facts, Labels(chosen.repo_id, private=True))
    return card


def _results(found: Found, films: int, files: dict[str, Content]) -> tuple[list[Evaluated], dict[str, str]]:
    """Evaluations after imitation and of this very checkpoint; tables, curve and films become files."""
    if found.run is None or found.step is None:
        return [], {}
    described = {}
    for table in TABLES:
        if len(read_rows(path := found.run / f"{table}.csv")) > 0:
            files[f"training/{table}.csv"] = path
            described[f"training/{table}.csv"] = f"every row of the run's {table}"
    rows = read_rows(judged := found.run / "evaluations.csv")
    if rows and not {*COLUMNS["evaluations"]} <= {*rows[0]}:
        raise DataError(f"{judged} is damaged: expected the columns {', '.join(COLUMNS['evaluations'])}.")
    # Of several at the same step the last.
    shown = {int(row["env_steps"]): row for row in rows if int(row["env_steps"]) in (0, found.step)}
    _draw(found, rows, files)
    if found.step in shown:
        stem = f"{shown[found.step]['phase']}_{found.step:06d}"
        files |= {f"videos/{path.name}": path for path in sorted(found.run.glob(f"videos/{stem}_*.mp4"))[:films]}
    return [
        Evaluated(
            f"{row['updates']} updates, {row['env_steps']} steps online",
            int(row["successes"]), int(row["n"]), float(row["ci_low"]), float(row["ci_high"]),
        )
        for row in shown.values()
    ], described  # fmt: skip


def _draw(found: Found, rows: list[dict[str, str]], files: dict[str, Content]) -> None:
    if not rows or found.run is None:
        return
    from ..run.curve import learning_curve

    try:
        files[CURVE] = learning_curve(read_rows(found.run / "episodes.csv"), rows)
    except CQNError as error:  # matplotlib is not installed
        note(f"The card has no learning curve: {error}")


def _training(found: Found, settings: Mapping[str, Any]) -> dict[str, str]:
    if not settings:
        return {}
    if "offline_updates" not in settings:
        return {
            "Trained with": "lerobot-train, offline", "Updates": str(found.step or settings.get("steps")),
            "Batch size": str(settings.get("batch_size")), "Seed": str(settings.get("seed")),
        }  # fmt: skip
    first = "offline on the demonstrations, then online" if settings["offline_updates"] else "online"
    rows = {
        "Trained with": f"cqn-train: {first}",
        "Offline updates": str(settings["offline_updates"]),
        "Seed": str(settings.get("seed")),
    }
    episodes = read_rows(found.run / "episodes.csv") if found.run is not None else []
    before = [row for row in episodes if found.step is None or int(row["env_steps"]) <= found.step]
    if before:
        last = before[-1]
        taught = sum(int(row.get("taught") or 0) for row in before)
        rows |= {
            "Online": f"{last['env_steps']} control steps in {len(before)} episodes",
            "Updates in all": last["updates"],
            "Steps that a person drove": str(taught),
            "Wall time": f"{float(last['wall_s']) / 60:.1f} minutes, evaluations included",
        }
    if changed := _schedule(settings):
        rows["Changed from the preset's schedule"] = ", ".join(f"{k}={v}" for k, v in changed.items())
    return rows


def _origin(settings: Mapping[str, Any]) -> str | None:
    """The policy that training began from: a name on the Hub, or that it was one on a disk."""
    path = (settings.get("policy") or {}).get("pretrained_path")
    if not path:
        return None
    on_hub = str(path).count("/") == 1 and not str(path).startswith(("/", ".")) and not Path(path).exists()
    return str(path) if on_hub else "another policy of its author"


def _schedule(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of the recipe that were given, and not left to the preset."""
    if "offline_updates" not in settings:
        return {}
    given = {name: settings.get(name) for name in RECIPE}
    return {k: v for k, v in given.items() if v is not None and (k != "async_updates" or v)}


def _task(env: Any, robot: Any, data: DataFacts | None) -> str:
    if env is not None:
        return f"{env.task} in {env.type}" if getattr(env, "task", None) else str(env.type)
    asked = data.about.get("Tasks") if data is not None else None
    where = f" with {robot.type}" if robot is not None else ""
    return (asked or (data.repo_id if data is not None else "a task that is not named")) + where


def _decoded(kind: Any, given: Any) -> Any:
    """A LeRobot configuration from what a run saved; None where there is none, or its plugin is not here."""
    if not given:
        return None
    try:
        return draccus.decode(kind, given)
    except Exception as error:  # draccus raises many kinds
        note(f"The card's commands are general: {' '.join(str(error).split())[:200]}")
        return None


def _without(values: Mapping[str, Any], private: set[tuple[str, ...]]) -> dict[str, Any]:
    """A copy with None in place of what is private."""
    copy: dict[str, Any] = json.loads(json.dumps(values))
    for *groups, name in private:
        inner: Any = copy
        for group in groups:
            inner = inner.get(group) or {}
        if name in inner:
            inner[name] = None
    return copy


def _json(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text())) if path.is_file() else {}
    except (ValueError, TypeError) as error:
        raise DataError(f"{path} is damaged ({error}): expected a JSON object.") from error


def _text(values: Mapping[str, Any]) -> bytes:
    return json.dumps(values, indent=2).encode()
