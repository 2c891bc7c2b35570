"""The card (README.md) of a dataset on the Hub: what it is, its action bounds, how it came about, how to train on it.

The part between two marks is written anew by each push; the rest of a card that a person wrote stays as it is.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_cqn.history_text import code, plain, rows_of, tell
from lerobot_cqn.schema import ACTION, NEXT_REWARD, NEXT_SUCCESS, dimension_names

from ..disk.pictures import picture_size
from ..disk.source import Source
from .readme import Readme, union

__all__ = ["TOOL", "Facts", "Labels", "look", "write_card"]

TOOL = "cqn-data push"
LICENSE, TAGS = "apache-2.0", ("LeRobot", "cqn-data")
MOST = 20  # tasks, or numbers of episodes, named in full
# As LeRobot's own card has it, so that the Hub's viewer finds the tables.
CONFIGS = [{"config_name": "default", "data_files": "data/*/*.parquet"}]
KINDS = {
    "command": "command minus measured position (executed as goal = measured + delta)",
    "command_steps": "command minus the command before (executed as goal = last goal + delta)",
    "state": "next measured position minus the present one (executed as goal = measured + delta)",
}
SUCCESS = {NEXT_SUCCESS: "are successes", NEXT_REWARD: "have a positive reward"}
CITATION = r"""@misc{cadene2024lerobot,
    author = {Cadene, Remi and Alibert, Simon and Soare, Alexander and Gallouedec, Quentin and Zouitine, Adil and
              Palma, Steven and Kooijmans, Pepijn and Aractingi, Michel and Shukor, Mustafa and Aubakirova, Dana and
              Russi, Martino and Capuano, Francesco and Pascal, Caroline and Choghari, Jade and Meftah, Khalil and
              Ellerbach, Maxime and Moss, Jess and Wolf, Thomas},
    title = {LeRobot: State-of-the-art Machine Learning for Real-World Robotics in Pytorch},
    howpublished = "\url{https://github.com/huggingface/lerobot}",
    year = {2024}
}"""


@dataclass(frozen=True)
class Facts:
    """Facts about a dataset for its card.

    Attributes:
        robot: its type; None where the recording does not say.
        fps: steps a second.
        lengths: steps of each episode.
        cameras: name -> height and width in pixels, and video or image.
        tasks: task -> episodes it occurs in.
        features: name -> dtype and shape.
        names: of the A action dimensions; none without actions.
        extremes: (2, A) smallest and largest action.
        bounds: (2, A) what training scales to -1 and 1.
        chosen: whether these bounds were set on purpose.
        deltas: kind and joints where actions are differences; None where nothing says so.
        rewards: how many episodes succeed; None without rewards.
        history: operations, oldest first.
    """

    robot: str | None
    fps: float
    lengths: list[int]
    cameras: dict[str, tuple[int, int, str]]
    tasks: dict[str, int]
    features: dict[str, tuple[str, tuple[int, ...]]]
    names: list[str]
    extremes: NDArray[np.float64]
    bounds: NDArray[np.float64]
    chosen: bool
    deltas: tuple[str, list[str]] | None
    rewards: str | None
    history: list[dict[str, Any]]


@dataclass(frozen=True)
class Labels:
    """Choices of the person who pushes: name on the Hub, licence (None: as it is, else Apache-2.0), further tags."""

    repo_id: str
    license: str | None = None
    tags: tuple[str, ...] = ()
    branch: str | None = None
    private: bool = False


def look(source: Source) -> Facts:
    """Facts from all numbers of a dataset, no pictures.

    Raises:
        DataError: an episode or the history cannot be read.
    """
    features, action = source.features, source.features.get(ACTION)
    names = dimension_names(action) if action else []
    low, high = np.full(len(names), np.inf), np.full(len(names), -np.inf)
    judged = next((k for k in (NEXT_SUCCESS, NEXT_REWARD) if k in features), None)
    won, tasks, lengths = 0, Counter[str](), []
    for index in source.episodes:
        episode = source.episode(index)
        lengths.append(len(episode))
        tasks.update(set(episode.tasks))
        columns = episode.columns
        won += judged is not None and bool((np.asarray(columns[judged]) > 0).any())
        if action:
            values = np.asarray(columns[ACTION], np.float64).reshape(len(episode), -1)
            low, high = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0))
    extremes, chosen, deltas = np.stack([low, high]), source.bounds, source.deltas
    return Facts(
        robot=source.meta.robot_type,
        fps=source.fps,
        lengths=lengths,
        cameras={k: (*picture_size(features[k]), features[k]["dtype"]) for k in source.cameras},
        tasks=dict(tasks.most_common()),
        features={k: (str(f["dtype"]), tuple(f["shape"])) for k, f in features.items()},
        names=names,
        extremes=extremes,
        bounds=extremes if chosen is None else np.stack([chosen.low, chosen.high]),
        chosen=chosen is not None,
        deltas=None if deltas is None else (deltas.kind, [names[i] for i in deltas.action_dims]),
        rewards=judged and f"{won} of {len(lengths)} episodes {SUCCESS[judged]}",
        history=source.history(),
    )


def write_card(facts: Facts, labels: Labels, base: str | None = None) -> str:
    """Text of the card.

    Args:
        facts: from :func:`look`.
        labels: name, licence and tags.
        base: the card that is there; what a person wrote in it stays, front matter included.

    Raises:
        DataError: the front matter of ``base`` is not YAML.
    """
    there = Readme.read(base or "", TOOL)
    front = dict(there.front)
    front["license"] = labels.license or front.get("license") or LICENSE
    front["task_categories"] = union(front.get("task_categories"), ["robotics"])
    front["tags"] = union(front.get("tags"), [*TAGS, *labels.tags])
    front.setdefault("configs", CONFIGS)
    return there.with_part(front, _section(facts, labels, str(front["license"])), labels.repo_id.partition("/")[2])


def _section(facts: Facts, labels: Labels, license: str) -> str:
    chapters = [
        "This dataset was created using [LeRobot](https://github.com/huggingface/lerobot). Prepared with `cqn-data`.",
        *([] if labels.private else [_badge(labels.repo_id)]),
        "## Dataset Description",
        _description(facts, license),
        *(["## Actions", _actions(facts)] if facts.names else []),
        "## History",
        tell(facts.history),
        "## Use",
        _use(labels),
        "## Dataset Structure",
        _structure(facts),
        "## Citation",
        f"**BibTeX:**\n\n```bibtex\n{CITATION}\n```",
    ]
    return "\n\n".join(chapters)


def _badge(repo_id: str) -> str:
    badge = "https://huggingface.co/datasets/huggingface/badges/resolve/main/visualize-this-dataset-xl"
    return (
        f'<a class="flex" href="https://huggingface.co/spaces/lerobot/visualize_dataset?path={repo_id}">\n'
        f'<img class="block dark:hidden" src="{badge}.svg"/>\n'
        f'<img class="hidden dark:block" src="{badge}-dark.svg"/>\n</a>'
    )


def _description(facts: Facts, license: str) -> str:
    steps, episodes = sum(facts.lengths), len(facts.lengths)
    minutes = steps / facts.fps / 60
    cameras = [f"`{code(k)}` {h}x{w} ({kind})" for k, (h, w, kind) in facts.cameras.items()]
    tasks = [f"{plain(t)} ({n})" for t, n in list(facts.tasks.items())[:MOST]]
    more = f"; and {len(facts.tasks) - MOST} more" if len(facts.tasks) > MOST else ""
    lines = {
        "Robot": plain(facts.robot or "not named"),
        "Size": f"{episodes} episodes, {steps} steps at {facts.fps} fps, {minutes:.1f} minutes",
        "Cameras (height x width)": ", ".join(cameras) or "none",
        "Tasks (episodes)": "; ".join(tasks) + more,
        "Rewards": facts.rewards or "none: no episode is marked as success or failure",
        "License": plain(license),
    }
    return "\n".join(f"- **{k}:** {v}" for k, v in lines.items())


def _actions(facts: Facts) -> str:
    text = "Nothing says that they are differences: taken as absolute."
    moved: list[str] = []
    if facts.deltas:
        kind, moved = facts.deltas
        text = f"Deltas of kind `{kind}`: {KINDS[kind]}."
        text += " The other dimensions are absolute." if len(moved) < len(facts.names) else ""
    set_by = "set with `cqn-data bounds`" if facts.chosen else "the smallest and largest action"
    rows = []
    for i, name in enumerate(facts.names):
        numbers = (*facts.extremes[:, i], *facts.bounds[:, i])
        rows.append([plain(name), "delta" if name in moved else "absolute", *(f"{v:.4g}" for v in numbers)])
    table = rows_of(["dimension", "action", "min", "max", "lower bound", "upper bound"], rows)
    return f"{text} Bounds, which training scales to -1 and 1, are {set_by}.\n\n{table}"


def _structure(facts: Facts) -> str:
    rows = [[plain(k), dtype, "x".join(map(str, shape))] for k, (dtype, shape) in facts.features.items()]
    return rows_of(["feature", "dtype", "shape"], rows)


def _use(labels: Labels) -> str:
    revision = f', revision="{labels.branch}"' if labels.branch else ""
    dataset = f"--dataset.repo_id={labels.repo_id}" + (f" --dataset.revision={labels.branch}" if labels.branch else "")
    return f"""```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("{labels.repo_id}"{revision})
```

```bash
lerobot-train --policy.type=cqn {dataset} --output_dir=outputs/cqn
```

`--policy.type=cqn` is Coarse-to-fine Q-Network, of the LeRobot plugin `lerobot_policy_cqn`."""
