"""The card (README.md) of a policy on the Hub: what it is, what it learned from, how good it is, how to go on.

`lerobot-train` writes it through `RLPolicy.generate_model_card`; `cqn-push` adds what a run left: results, curve,
films.
"""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import draccus
import numpy as np
import yaml
from huggingface_hub import EvalResult, ModelCardData

from .base_config import RLConfig
from .history_text import code, plain, rows_of, tell
from .joint_goals import converted_deltas
from .schema import ACTION, dimension_names, read_history

__all__ = [
    "Commands",
    "DataFacts",
    "Evaluated",
    "ModelFacts",
    "as_readme",
    "commands",
    "data_facts",
    "front_matter",
    "write_part",
]

LICENSE = "apache-2.0"
METHODS = {
    "cqn": (
        "Coarse-to-fine Q-Network (CQN)",
        "It has a critic and no actor: it looks for the action of the highest Q-value in a few intervals of each "
        "action dimension, then zooms into the best one, level by level.",
    ),
    "cqn_as": (
        "CQN-AS",
        "It is CQN whose critic values a sequence of the next actions (Seo and Abbeel 2024).",
    ),
    "drqv2": ("DrQ-v2", "It is the actor-critic baseline of the CQN paper, with a distributional critic in DrQ-v2+."),
}
# Of a configuration, what is a machine's own or follows from the rest.
OWN = {
    "type", "id", "port", "calibration_dir", "person", "person_takes_over_s", "person_helps_episodes", "features",
    "features_map", "discover_packages_path",
}  # fmt: skip
PACKAGES = ("lerobot_policy_cqn", "lerobot", "torch")
CITATION = r"""@inproceedings{seo2024continuous,
  title     = {Continuous Control with Coarse-to-fine Reinforcement Learning},
  author    = {Seo, Younggyo and Uru\c{c}, Jafar and James, Stephen},
  booktitle = {Conference on Robot Learning},
  year      = {2024}
}"""


@dataclass(frozen=True)
class DataFacts:
    """The demonstrations.

    repo_id: as user/name. about: what it is -> a sentence. history: operations of `meta/cqn_history.json`, oldest
    first; None where the dataset could not be read. actions: a row each of name, kind, lower and upper bound. fps:
    steps a second. public: whether it is on the Hub under its name, as far as is known.
    """

    repo_id: str
    about: Mapping[str, str] = field(default_factory=dict)
    history: Sequence[Mapping[str, Any]] | None = None
    actions: Sequence[tuple[str, str, str, str]] = ()
    fps: int | None = None
    public: bool = True


@dataclass(frozen=True)
class Evaluated:
    """Success over n evaluation episodes of the deterministic policy, with its 95 % interval; after: what."""

    after: str
    successes: int
    n: int
    low: float
    high: float

    @property
    def rate(self) -> float:
        """Success rate."""
        return self.successes / self.n


@dataclass(frozen=True)
class Commands:
    """Commands to type: each is a shell command over one or several lines."""

    evaluate: str
    go_on: str


@dataclass(frozen=True)
class ModelFacts:
    """Facts about a policy for its card.

    Attributes:
        repo_id: name on the Hub.
        config: the policy's.
        task: for a person, e.g. "click_button in ur5e_station".
        training: what it is -> a sentence, e.g. "Online steps" -> "2400".
        commands: to evaluate it and to go on.
        license: None: Apache-2.0.
        tags: further ones.
        data: the demonstrations; None where there were none.
        results: evaluations, in the order of training; the last one is the policy's.
        origin: the policy that it was continued from: user/name on the Hub, or what else to call it; None: none.
        curve: path of a picture in the repository.
        films: paths of films in the repository.
        files: further paths -> what they hold.
    """

    repo_id: str
    config: RLConfig
    task: str
    training: Mapping[str, str]
    commands: Commands
    license: str | None = None
    tags: Sequence[str] = ()
    data: DataFacts | None = None
    results: Sequence[Evaluated] = ()
    origin: str | None = None
    curve: str | None = None
    films: Sequence[str] = ()
    files: Mapping[str, str] = field(default_factory=dict)


def data_facts(meta: Any, repo_id: str, episodes: Sequence[int] | None = None, *, public: bool = True) -> DataFacts:
    """Facts that LeRobot's metadata `meta` and the dataset's history tell; episodes: those used, None: all.

    Raises DataError when the history is damaged.
    """
    used = list(range(meta.total_episodes)) if episodes is None else list(episodes)
    steps = sum(int(meta.episodes["length"][i]) for i in used)
    tasks = [plain(str(task)) for task in list(meta.tasks.index)[:5]]
    about = {
        "Robot": plain(str(meta.robot_type or "not named")),
        "Size": f"{len(used)} episodes, {steps} steps at {meta.fps} a second ({steps / meta.fps / 60:.1f} minutes)",
        "Tasks": "; ".join(tasks) or "not named",
    }
    names = dimension_names(meta.features[ACTION])
    deltas = converted_deltas(meta)
    changed = set() if deltas is None else {names[i] for i in deltas.action_dims}
    stats = (meta.stats or {}).get(ACTION, {})
    bounds = [np.asarray(stats[end]).reshape(-1) for end in ("min", "max")] if "min" in stats else []
    rows = [
        (plain(name), action_kind(name in changed, any_changed=bool(changed)), *(f"{end[i]:.4g}" for end in bounds))
        for i, name in enumerate(names)
    ]
    return DataFacts(
        repo_id, about, read_history(meta.root), [row for row in rows if len(row) == 4], int(meta.fps), public
    )


def commands(
    repo_id: str, *, env: Any = None, robot: Any = None, teleop: Any = None, dataset: str = "", fps: int | None = None,
    more: Sequence[str] = (),
) -> Commands:  # fmt: skip
    """Commands to evaluate the policy `repo_id` and to train on, where it was trained.

    env, robot, teleop: LeRobot's configurations, or None. dataset: its name, "" for none. fps: control steps a second
    of a robot, None: not known. more: options of the training that differ from what the policy's preset asks for.
    """
    data = [f"--dataset.repo_id={dataset}"] if dataset else []
    go_on = ["cqn-train", f"--policy.path={repo_id}"]
    if robot is not None:
        arm = _flags("robot", robot)
        leader = _flags("teleop", teleop) if teleop is not None else []
        evaluate = ["lerobot-rollout", f"--policy.path={repo_id}", *arm, f"--fps={fps or '...'}", "--duration=60"]
        go_on += [*arm, *leader, *data, "--online_minutes=10"]
    else:
        place = _flags("env", env) if env is not None else ["--env.type=..."]
        evaluate = ["lerobot-eval", f"--policy.path={repo_id}", *place, "--eval.n_episodes=50", "--eval.batch_size=5"]
        go_on += [*place, *data, "--steps=2000"]
    return Commands(_shell(evaluate), _shell([*go_on, *more, "--output_dir=outputs/continued"]))


def front_matter(facts: ModelFacts) -> dict[str, Any]:
    """Front matter, which the Hub reads: licence, library, tags, dataset, and the last result."""
    results = None
    if facts.results:
        last = facts.results[-1]
        name = f"success rate (n={last.n}, 95 % {last.low:.2f}-{last.high:.2f})"
        results = [
            EvalResult(
                task_type="robotics", dataset_type="robot-task", dataset_name=facts.task,
                metric_type="success_rate", metric_value=round(last.rate, 4), metric_name=name,
            )
        ]  # fmt: skip
    tags = list(dict.fromkeys(["robotics", "lerobot", facts.config.type, "reinforcement-learning", *facts.tags]))
    card = ModelCardData(
        license=facts.license or LICENSE, library_name="lerobot", pipeline_tag="robotics", tags=tags,
        model_name=facts.repo_id.partition("/")[2] or facts.config.type, eval_results=results,
        datasets=[facts.data.repo_id] if facts.data is not None and facts.data.public else None,
        base_model=facts.origin if facts.origin and "/" in facts.origin else None,
    )  # fmt: skip
    return dict(card.to_dict())  # type: ignore[no-untyped-call]


def as_readme(facts: ModelFacts, endpoint: str) -> str:
    """A whole card; endpoint: as for `write_part`."""
    head = yaml.safe_dump(front_matter(facts), sort_keys=False, allow_unicode=True, width=1000)
    return f"---\n{head}---\n\n# {facts.repo_id.partition('/')[2]}\n\n{write_part(facts, endpoint)}\n"


def write_part(facts: ModelFacts, endpoint: str) -> str:
    """The card's text below its title, in Markdown. endpoint: address of the Hub, for pictures and films."""
    chapters = [
        _introduction(facts),
        *_pictures(facts, endpoint),
        "## Results",
        _results(facts),
        "## Use",
        _use(facts),
        "## Observation and action",
        _features(facts),
        "## Data",
        _data(facts),
        "## Training",
        _training(facts),
        "## Files",
        _files(facts),
        "## Licence and citation",
        f"{plain(facts.license or LICENSE)}. The algorithm is from\n\n```bibtex\n{CITATION}\n```",
    ]
    return "\n\n".join(chapters)


def _flags(group: str, config: Any) -> list[str]:
    """Options of a LeRobot configuration that differ from its type's defaults; no ports, names or folders."""
    given = draccus.encode(config)
    try:
        usual = draccus.encode(type(config)())
    except Exception:  # one that needs a port has no defaults; any check may fail
        usual = {}
    flags = [f"--{group}.type={config.type}"]
    for name, value in given.items():
        if name == "port":
            flags.append(f"--{group}.port=...")
        if name in OWN or value is None or isinstance(value, dict) or (value == usual.get(name) and name != "task"):
            continue
        text = f"[{','.join(map(str, value))}]" if isinstance(value, list | tuple) else str(value)
        flags.append(f"--{group}.{name}={text.lower() if isinstance(value, bool) else text}")
    return flags


def _shell(arguments: Sequence[str], width: int = 110) -> str:
    lines, line = [], ""
    for argument in arguments:
        word = argument if argument.endswith("=...") else shlex.quote(argument)
        if line and len(line) + len(word) > width:
            lines.append(line)
            line = "  " + word
        else:
            line = f"{line} {word}" if line else word
    return " \\\n".join([*lines, line])


def _introduction(facts: ModelFacts) -> str:
    name, how = METHODS.get(facts.config.type, (facts.config.type, ""))
    learned = "from demonstrations" if facts.data is not None else "without demonstrations"
    learned += f", continued from {_origin(facts.origin)}," if facts.origin else ""
    rate = ""
    corrected = facts.config.base_path
    base = f" It corrects what {_origin(corrected)} does, and needs that policy to act." if corrected else ""
    if facts.results:
        last = facts.results[-1]
        rate = f" It succeeds in {last.successes} of {last.n} evaluation episodes."
    return (
        f"A **{name}** policy for [LeRobot](https://github.com/huggingface/lerobot), trained {learned} on "
        f"**{plain(facts.task)}**.{rate} {how}{base}".rstrip()
    )


def _origin(origin: str) -> str:
    return f"[{plain(origin)}](https://huggingface.co/{origin})" if "/" in origin else plain(origin)


def _pictures(facts: ModelFacts, endpoint: str) -> list[str]:
    where = f"{endpoint}/{facts.repo_id}/resolve/main"
    shown = [f"![Success rate in the course of training]({facts.curve})"] if facts.curve else []
    return shown + [f'<video src="{where}/{film}" controls muted loop width="320"></video>' for film in facts.films]


def _results(facts: ModelFacts) -> str:
    if not facts.results:
        return "It has not been evaluated in the course of training: see below for the command that does it."
    rows = [
        (plain(r.after), f"{r.rate:.2f}", f"{r.successes}/{r.n}", f"{r.low:.2f} - {r.high:.2f}") for r in facts.results
    ]
    text = "Success rate of the deterministic policy over evaluation episodes; one training run."
    return f"{text}\n\n{rows_of(('after', 'success rate', 'successes', '95 % interval (Wilson)'), rows)}"


def _use(facts: ModelFacts) -> str:
    local = ""
    if facts.data is not None and not facts.data.public:
        local = " The demonstrations are not on the Hub: name a dataset of yours, and its folder with `--dataset.root`."
    return (
        "The policy is part of the LeRobot plugin `lerobot_policy_cqn`; where it is installed, LeRobot finds it by "
        f"itself.\n\nEvaluate:\n\n```bash\n{facts.commands.evaluate}\n```\n\n"
        f"Continue training online, from these weights.{local}\n\n```bash\n{facts.commands.go_on}\n```"
    )


def _features(facts: ModelFacts) -> str:
    config, s = facts.config, facts.config.settings
    rows = [(f"`{code(key)}`", "x".join(map(str, f.shape))) for key, f in (config.input_features or {}).items()]
    text = rows_of(("observation", "shape"), rows)
    text += f"\n\nThe last {s.frame_stack} frames are seen together." if s.frame_stack > 1 else ""
    action = config.action_feature
    size = action.shape[0] if action is not None else 0
    text += "\n\n" if s.frame_stack == 1 else " "
    text += f"State is scaled to [-1, 1] by the demonstrations' range and cut at ±{s.state_bound:g}."
    text += f"\n\nAn action of {size} dimensions, [-1, 1] for the network"
    actions = facts.data.actions if facts.data is not None else ()
    if not actions:
        return text + "; its processors hold the bounds."
    margin = f", widened by {s.action_margin:g} of the range on each side" if s.action_margin else ""
    margin += f", widened by {s.bound_margin:g} of each bound's absolute value" if s.bound_margin else ""
    return f"{text}; these bounds{margin}:\n\n" + rows_of(
        ("dimension", "action", "lower bound", "upper bound"), actions
    )


def _data(facts: ModelFacts) -> str:
    if facts.data is None:
        return "None: the policy learned from its own experience alone."
    data = facts.data
    name = f"`{code(data.repo_id)}`, on a disk and not on the Hub"
    if data.public:
        name = f"[{plain(data.repo_id)}](https://huggingface.co/datasets/{data.repo_id})"
    lines = [f"- **Dataset:** {name}", *(f"- **{what}:** {text}" for what, text in data.about.items())]
    if data.history is None:
        return "\n".join(lines) + "\n\nHow it was prepared is not known here: the dataset could not be read."
    return "\n".join(lines) + "\n\nHow it was prepared:\n\n" + tell(data.history)


def _training(facts: ModelFacts) -> str:
    changed = changed_from_preset(facts.config)
    rows = [
        ("Preset", f"`{code(facts.config.preset)}`"),
        ("Changed from the preset", ", ".join(f"`{code(k)}={v}`" for k, v in changed.items()) or "nothing"),
        *((plain(what), plain(text)) for what, text in facts.training.items()),
        ("Versions", ", ".join(f"{name} {found}" for name, found in versions().items())),
    ]
    text = (
        "Presets, and every deviation from the paper and from its authors' implementation, are listed in the plugin's "
        "`docs/algorithm.md`; `config.json` has every number."
    )
    return f"{rows_of(('', ''), rows)}\n\n{text}"


def _files(facts: ModelFacts) -> str:
    rows = {
        "model.safetensors, config.json": "weights for inference, target network included, and settings; "
        "no optimiser state",
        "policy_preprocessor*, policy_postprocessor*": "scaling, bounds and joint goals, which LeRobot applies",
        "train_config.json": "the command's settings, without folders of the machine",
        **({facts.curve: "success rate in the course of training"} if facts.curve else {}),
        **dict.fromkeys(facts.films, "an evaluation episode"),
        **facts.files,
    }
    return rows_of(("file", "what"), [(f"`{code(name)}`", plain(what)) for name, what in rows.items()])


def action_kind(changed: bool, *, any_changed: bool) -> str:
    """Kind of an action dimension: `cqn-data delta` made differences of it, or left it, or nothing was converted."""
    return "joint difference" if changed else "absolute" if any_changed else "as the robot takes it"


def changed_from_preset(config: RLConfig) -> dict[str, Any]:
    """Numbers of the configuration that are not its preset's."""
    usual = asdict(type(config)(preset=config.preset, device=config.device).settings)
    return {name: value for name, value in asdict(config.settings).items() if value != usual[name]}


def versions() -> dict[str, str]:
    """Of the packages that decide what a policy does."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:  # run from a folder, never installed
            continue
    return found
