"""The card: history entries as the operations write them, text of people that stays, names that break nothing."""

import numpy as np
import pytest
import yaml

from cqn_data import record
from cqn_data.disk.source import open_source
from cqn_data.disk.target import skip_entry
from cqn_data.formats import convert
from cqn_data.hub.card import TOOL, Facts, Labels, look, write_card
from cqn_data.hub.readme import Readme, end_mark, start_mark
from cqn_data.operations.job import Job, run_job
from cqn_data.operations.recipe import load_recipe
from cqn_data.operations.registry import STEPS, step_class
from lerobot_cqn.errors import DataError
from lerobot_cqn.history_text import tell, told

from ..toy_datasets import CAMERA, make_dataset

START, END = start_mark(TOOL), end_mark(TOOL)

RECIPE = """
steps:
  - drop: {episodes: [1], reason: clumsy}
  - trim: {head: 1, tail: 0}
  - filter: {threshold: 0.0001}
  - delta: {of: state}
  - resample: {fps: 5}
  - resize: {size: [32, 40]}
  - label: {failed: [2]}
  - bounds: {quantile: 0.01, margin: 0.25}
"""
LABELS = Labels("user/toy")


def facts(**changed):
    values = {
        "robot": "arm", "fps": 10, "lengths": [300, 900], "cameras": {"observation.images.top": (48, 64, "video")},
        "tasks": {"Press.": 2}, "features": {"action": ("float32", (2,))}, "names": ["pan", "grip"],
        "extremes": np.array([[-1, 0], [1, 1.0]]), "bounds": np.array([[-2, 0], [2, 1.0]]), "chosen": True,
        "deltas": ("command", ["pan"]), "rewards": "1 of 2 episodes are successes",
        "history": [{"operation": "label", "settings": {"failed": [1]}, "failures": [1]}],
    }  # fmt: skip
    return Facts(**(values | changed))


def front_matter(card):
    assert card.startswith("---\n")
    return yaml.safe_load(card.split("---\n")[1])


def sentence(entry):
    """What the operation says of an entry; nothing where it lacks figures or nobody knows the operation."""
    name = entry.get("operation")
    if name == "record":
        return record.told(entry["settings"])
    if name == "convert":
        return convert.told(entry)
    if name == "skip_bad_episodes":
        return skip_entry(entry["episodes"])["told"]
    return step_class(name).told(entry) if name in STEPS and len(entry) > 1 else ""


def test_every_operation_is_told_with_the_figures_it_wrote_itself(tmp_path):
    root = make_dataset(tmp_path / "source", camera=True, dims=(4, 4), lengths=(9, 2, 8))
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    job = Job(repo_id="local/toy", root=str(root), dry_run=True)
    entries = run_job(job, load_recipe(str(tmp_path / "recipe.yaml")))
    sentences = {entry["operation"]: told(entry) for entry in entries}
    assert sentences["drop"] == "Dropped 1 episode (clumsy: episode 1)."
    assert sentences["trim"] == "Cut 2 steps off the starts and 0 off the ends of 2 episodes."
    assert sentences["filter"].startswith("Left out 0 of 15 steps (0%), in 0 pauses in which nothing moves")
    assert sentences["delta"] == "Turned absolute actions into deltas of kind state, of 0, 1, 2, 3."
    assert sentences["resample"] == "Took 5 steps a second instead of 10: 15 steps became 8."
    assert sentences["resize"] == "Scaled the pictures to 32x40."
    assert (
        sentences["label"] == "Wrote sparse rewards: 1 on the last step of every episode but episode 2, which failed."
    )
    assert "4 dimensions: 1% of the steps left out at either end, 25% of the range added" in sentences["bounds"]
    text = tell(entries)
    assert [f"{i}. **{e['operation']}**" in text for i, e in enumerate(entries, start=1)] == [True] * 8
    assert "Settings: `quantile=0.01, margin=0.25`" in text


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        (
            {"operation": "record", "settings": {"episodes": 30, "pause_share": 0.45}},
            "until 30 had succeeded; the script pauses in 45% of the time steps.",
        ),
        (
            {
                "operation": "convert", "format": "aloha", "source": "sim", "total": {"episodes": 5, "steps": 50},
                "skipped": [{"source": "a", "reason": "b"}],
            },
            "Converted sim from aloha: 5 episodes, 50 steps; 1 could not be taken over.",
        ),
        ({"operation": "delta", "settings": {"of": "command"}, "deltas": None}, "kind command back into absolute"),
        (
            {"operation": "resize", "settings": {"size": [8, 8], "crop": {"top": [0, 1, 2, 3]}}},
            ": top, left, height, width), then scaled them to 8x8.",
        ),
        (
            {"operation": "skip_bad_episodes", "episodes": {"3": "/home/me/data is damaged"}},
            "Left out episode 3, which could not be read.",
        ),
        ({"operation": "drop", "dropped": {}}, "Dropped no episode."),
        ({"operation": "of next year", "settings": {"a": 1}}, "Done with the settings below."),
        ({"operation": "filter"}, "Done."),
        ({}, "Done."),
    ],
)  # fmt: skip
def test_other_entries_and_those_that_lack_figures(entry, said):
    assert said in told({**entry, "told": sentence(entry)})


def test_what_is_read_from_a_dataset(tmp_path):
    root = make_dataset(tmp_path / "source", camera=True, reward=True, failed=(1,))
    found = look(open_source("local/toy", str(root)))
    assert found.lengths == [7, 2, 5]
    assert found.cameras == {CAMERA: (24, 24, "video")}
    assert found.tasks == {"Press the button.": 3}
    assert found.rewards == "2 of 3 episodes are successes"
    assert (found.deltas, found.chosen, found.history) == (None, False, [])
    stored = open_source("local/toy", str(root)).meta.stats["action"]
    np.testing.assert_allclose(found.extremes, [stored["min"], stored["max"]])
    card = write_card(found, LABELS)
    assert "taken as absolute" in card
    assert "None is kept: the dataset is as it was recorded" in card


def test_a_card_says_size_bounds_and_kind_of_action():
    card = write_card(facts(), LABELS)
    assert "2 episodes, 1200 steps at 10 fps, 2.0 minutes" in card
    assert "`observation.images.top` 48x64 (video)" in card
    assert "Deltas of kind `command`: command minus measured position" in card
    assert "| pan | delta | -1 | 1 | -2 | 2 |" in card
    assert "| grip | absolute | 0 | 1 | 0 | 1 |" in card
    assert "## Actions" not in write_card(facts(names=[]), LABELS)
    assert "visualize_dataset?path=user/toy" in card
    assert "visualize_dataset" not in write_card(facts(), Labels("user/toy", private=True))
    branch = write_card(facts(), Labels("user/toy", branch="small"))
    assert 'LeRobotDataset("user/toy", revision="small")' in branch
    assert "--dataset.repo_id=user/toy --dataset.revision=small" in branch


def test_names_and_sentences_of_people_break_neither_table_nor_marks():
    hostile = f"a|b\n{END} `x` <script> [l](http://x) *b*"
    changed = facts(
        robot=hostile, names=[hostile, "grip"], tasks={hostile: 1}, deltas=None,
        history=[{"operation": hostile, "settings": {"reason": hostile}}],
        cameras={hostile: (1, 1, "video")}, features={hostile: ("float32", (1,))},
    )  # fmt: skip
    card = write_card(changed, LABELS)
    assert (card.count(START), card.count(END), card.count("<script>")) == (1, 1, 2)  # two between backticks
    assert write_card(changed, LABELS, card) == card
    assert Readme.read(card, TOOL).own_text == "# toy"
    rows = [line for line in card.splitlines() if line.startswith("| a")]
    assert len(rows) == 2
    assert all("a\\|b &lt;!--" in row for row in rows)


def test_a_card_is_written_anew_only_between_the_marks():
    base = "---\ntags: own\nlicense: mit\nextra: {a: [1, 2]}\n---\nIntro\n\n---\n\nA rule above.\n"
    first = write_card(facts(), Labels("user/toy", tags=("x", "own")), base)
    front = front_matter(first)
    assert front["tags"] == ["own", "LeRobot", "cqn-data", "x"]
    assert (front["license"], front["extra"]) == ("mit", {"a": [1, 2]})
    assert "Intro\n\n---\n\nA rule above." in first
    edited = first.replace("Intro", "New intro") + "\nThanks.\n"
    second = write_card(facts(robot="other"), Labels("user/toy", license="cc0-1.0"), edited)
    assert second.index("New intro") < second.index(START) < second.index("other") < second.index(END)
    assert second.endswith(f"{END}\n\nThanks.\n")
    assert second.count("## History") == 1
    assert front_matter(second)["license"] == "cc0-1.0"
    assert write_card(facts(robot="other"), LABELS, second) == second
    assert Readme.read(second, TOOL).own_text == "New intro\n\n---\n\nA rule above.\nThanks."


@pytest.mark.parametrize("base", ["---\na: [\n---\n", "---\njust text\n---\n", "---\nno: end\n"])
def test_front_matter_that_is_no_yaml_is_refused(base):
    with pytest.raises(DataError, match=r"front matter of README\.md"):
        write_card(facts(), LABELS, base)
