"""Production code against tensors computed by the authors' implementation; see README.md beside this file."""

from pathlib import Path

import pytest

from .check import CHECKS, check_file, kind, main

HERE = Path(__file__).parent
FILES = sorted(HERE.glob("*.npz"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_agrees_with_the_authors_implementation(path: Path) -> None:
    beyond = [deviation for deviation in check_file(path) if not deviation.ok]
    assert not beyond


def test_every_kind_of_file_is_there() -> None:
    assert {kind(path) for path in FILES} == set(CHECKS)


def test_command_reports_what_it_checked(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(HERE)]) == 0
    assert f"{len(FILES)} files, 0 quantities beyond tolerance" in capsys.readouterr().out


def test_command_refuses_a_folder_without_tensors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert "found none" in capsys.readouterr().err
