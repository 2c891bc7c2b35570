"""Run `cqn-data convert` and look at what it wrote; shared by the tests of the formats."""

import json
import logging

import numpy as np
import pandas as pd
import pytest

from cqn_data.cli import main

LOSSLESS = "--video=false"
NONE = "--image_keys=[none]"


@pytest.fixture(name="_logs", autouse=True)
def logs_fixture():
    """The command silences its process; the next test hears again."""
    yield
    logging.disable(logging.NOTSET)


@pytest.fixture(name="target")
def target_fixture(tmp_path):
    """Where to write; at the end there may be a dataset or nothing, but no half one."""
    yield tmp_path / "out" / "dst"
    assert [p.name for p in tmp_path.glob("out/*") if p.name != "dst"] == []


def convert(kind, source, target, *options):
    """Convert with the command line and return its exit code."""
    names = [f"--from={kind}", f"--input={source}", "--new_repo_id=local/dst", f"--new_root={target}"]
    return main(["convert", *names, *options])


def rows(root):
    return pd.concat([pd.read_parquet(f) for f in sorted((root / "data").glob("*/*.parquet"))]).reset_index(drop=True)


def column(root, key):
    return np.stack(rows(root)[key])


def history(root):
    (entry,) = json.loads((root / "meta/cqn_history.json").read_text())["operations"]
    return entry


def frame(dataset, index, camera):
    """(H, W, 3) uint8 of one stored picture."""
    return np.rint(dataset[index][f"observation.images.{camera}"].numpy().transpose(1, 2, 0) * 255).astype(np.uint8)


def snapshot(root):
    """Content and time of every file, to see that nothing was touched."""
    files = [root] if root.is_file() else sorted(p for p in root.rglob("*") if p.is_file())
    return {str(p): (p.stat().st_mtime_ns, p.read_bytes()) for p in files}


def refusal(capsys, kind, source, target, *options, code=2):
    """The one line with which a conversion ends that writes nothing."""
    capsys.readouterr()
    assert convert(kind, source, target, *options) == code
    out, err = capsys.readouterr()
    lines = [line for line in err.splitlines() if "error:" in line or "unexpected" in line]
    assert len(lines) == 1, err
    assert "Traceback" not in out + err
    assert not target.exists()
    return lines[0]
