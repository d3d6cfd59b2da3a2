"""The help says what each command answers, uncut, and an example that the command understands."""

from __future__ import annotations

import shlex

import pytest
from typer.main import get_command

from mitsuba_crb.cli import app as cli

GROUP = get_command(cli.app)
COMMANDS = sorted(GROUP.commands)


def test_every_command_is_listed_uncut_by_the_question_it_answers(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["--help"]) == 0
    lines = capsys.readouterr().out.partition("Commands:")[2].splitlines()
    said = dict(line.split(maxsplit=1) for line in lines if line.strip())
    assert sorted(said) == COMMANDS
    for name, line in said.items():
        assert "..." not in line
        assert "?" in line, name
        assert line == GROUP.commands[name].help.splitlines()[0]


@pytest.mark.parametrize("name", COMMANDS)
def test_the_example_is_understood(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run([name, "--help"]) == 0
    words = shlex.split(capsys.readouterr().out.rpartition("Example: mitsuba-crb ")[2])
    assert words[0] == name
    command = GROUP.commands[name]
    command.make_context(name, words[1:])  # which raises at what it does not know
    wrong = [*words[1:], "--no-such-option"]
    with pytest.raises(Exception, match=r"[Nn]o such option"):
        command.make_context(name, wrong)


def test_shells_complete_commands(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, value in (
        ("_MITSUBA_CRB_COMPLETE", "complete_bash"),
        ("COMP_WORDS", "mitsuba-crb va"),
        ("COMP_CWORD", "1"),
    ):
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        cli.run([])
    assert capsys.readouterr().out.split() == ["validate"]
