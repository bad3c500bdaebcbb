"""What a user is told: nothing that a terminal obeys, and suggestions that work as they stand."""

import io
import json
import shlex
import sys
from dataclasses import asdict, replace

import pytest
from click.testing import CliRunner
from rich.console import Console
from small_studies import run_serially, small_mapping, small_spec

import sweep
from sweep.cli import main
from sweep.cli.terminal import print_table
from sweep.messages import (
    EscapingStream,
    escape_to_one_line,
    escape_unprintable,
    suggest_shell_commands,
    suggested_call,
)
from sweep.spec import SpecError
from sweep.tasks.engine import progress
from sweep.tasks.engine.journal import LockHolder
from sweep.tasks.engine.progress import RunRequestError, StoreBusyError, StoreError

HOSTILE = "\x1b]0;owned\x07\x1b[2J\x9b31m\r\u202egnp\u2066\u200b\x7f"
"""Escape sequences of 7 and 8 bits, a carriage return, and marks that turn text around."""

OBEYED = set(HOSTILE) - set("]0;owned[2J31mgnp")


def command_output(*arguments, exit_code=0):
    """Output of a command, none of which a terminal obeys."""
    result = CliRunner().invoke(main, [*map(str, arguments)])
    assert result.exit_code == exit_code, result.output
    assert not OBEYED & set(result.output), result.output
    return result.output


@pytest.mark.parametrize("character", sorted(OBEYED))
def test_each_character_that_a_terminal_obeys_is_shown_as_an_escape_sequence(character):
    code = ord(character)
    escaped = f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}"
    assert escape_unprintable(f"a{character}b") == f"a{escaped}b"


@pytest.mark.parametrize("text", ["two\nlines\tand a tab", "25 µm, 90°, Zürich, 雷达, 🛰", ""])
def test_text_that_is_only_read_stays_as_it_is(text):
    assert escape_unprintable(text) == text


def test_text_of_one_line_cannot_forge_another():
    assert escape_to_one_line("node1\ncomplete\t") == "node1\\ncomplete\\t"


def test_a_stream_is_written_to_by_nothing_else_than_printable_text():
    raw = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    stream = EscapingStream(raw)
    print(HOSTILE, file=stream, flush=True)
    assert not OBEYED & set(raw.buffer.getvalue().decode())
    assert not hasattr(stream, "buffer")
    with pytest.raises(TypeError):
        stream.write(b"\x1b")


def fails(study, block):
    raise ValueError(HOSTILE)


def test_failures_locks_and_titles_of_a_store_are_reported_in_printable_text(tmp_path):
    store = tmp_path / "a.zarr"
    spec = small_spec(title="A\nstudy")
    outcome = run_serially(spec, store, scheduler="none", evaluate=fails)
    assert not outcome.complete and outcome.failures
    text = command_output("status", store)
    assert "block 0 failed on" in text and "\\x1b]0;owned\\x07" in text
    lock = replace(LockHolder.of_this_process(), host=f"{HOSTILE}\ncomplete", token="another")
    (store / ".sweep" / "lock").write_text(json.dumps(asdict(lock)))
    text = command_output("status", store)
    assert "running: process" in text and "complete" not in text.splitlines()
    text = command_output("resume", store, "--scheduler", "none", exit_code=2)
    assert "is being written by process" in text and "complete" not in text.splitlines()
    with pytest.raises(StoreBusyError) as error_info:
        sweep.resume(store, progress=False)
    assert not OBEYED & set(str(error_info.value))


def test_versions_and_ids_in_a_store_are_reported_in_printable_text(tmp_path):
    store = tmp_path / "a.zarr"
    assert run_serially(small_spec(), store).complete
    document = json.loads((store / "zarr.json").read_text())
    software = document["attributes"]["software"]
    document["attributes"] |= {
        "title": HOSTILE, "software": f"{software}, {HOSTILE} {HOSTILE}",
    }  # fmt: skip
    (store / "zarr.json").write_text(json.dumps(document))
    command_output("status", store)
    command_output("resume", store, exit_code=2)
    command_output("verify", store, exit_code=1)
    document["attributes"]["study_id"] = HOSTILE
    (store / "zarr.json").write_text(json.dumps(document))
    for command in ("status", "resume", "report"):
        command_output(command, store, exit_code=2)
    command_output("verify", store, exit_code=1)
    with pytest.raises(StoreError) as error_info:
        sweep.resume(store)
    assert not OBEYED & set(str(error_info.value))


@pytest.mark.parametrize(
    "arguments",
    [
        ["plan", "HOSTILE.yaml"], ["status", "HOSTILE.zarr"], ["HOSTILE"], ["plan", "--HOSTILE"],
        ["--HOSTILE"], ["instruments", "HOSTILE"], ["run", "a.yaml", "--workers", "HOSTILE"],
        ["extend", "a.zarr", "--set", "HOSTILE"], ["extend", "a.zarr", "--set", "HOSTILE=1"],
    ],
)  # fmt: skip
def test_names_on_the_command_line_are_reported_in_printable_text(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command_output(*(word.replace("HOSTILE", HOSTILE) for word in arguments), exit_code=2)


def test_a_spec_s_words_are_reported_in_printable_text(tmp_path):
    words = json.dumps(HOSTILE)  # which YAML reads
    file = tmp_path / "a.yaml"
    file.write_text(f"title: {words}\n{words}: 1\ninstrument: {words}\naxes: {{{words}: [1]}}\n")
    assert "\\x1b" in command_output("plan", file, exit_code=2)
    with pytest.raises(SpecError) as error_info:
        sweep.load(file)
    assert not OBEYED & set(str(error_info.value))


def test_tables_and_lines_of_a_run_are_printable(capsys, monkeypatch):
    print_table(HOSTILE, ["one", "two"], [[HOSTILE, "a\nb"]])
    progress.ProgressLines().say(HOSTILE)
    stream = io.StringIO()
    monkeypatch.setattr(progress, "sys", sys)
    bar = progress.ProgressBar()
    bar.console = Console(file=stream, force_terminal=True)
    bar.say(HOSTILE)
    out, err = capsys.readouterr()
    assert not OBEYED & set(out + err + stream.getvalue())


def test_a_traceback_after_a_command_is_printable(monkeypatch, capsys):
    def broken(*_):
        raise RuntimeError(HOSTILE)

    monkeypatch.setattr("sweep.spec.yaml_document.library_instrument_files", broken)
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, getattr(sys, name))  # put back afterwards
    with pytest.raises(RuntimeError) as error_info:
        main(["instruments"])
    sys.excepthook(error_info.type, error_info.value, error_info.tb)
    err = capsys.readouterr().err
    assert "RuntimeError: \\x1b" in err and not OBEYED & set(err)


# Suggestions


@pytest.mark.parametrize("name", ["my lidar.zarr", "a'b.zarr", "$(rm x).zarr", "-x.zarr", "ä;b"])
def test_a_command_that_is_suggested_names_the_path_whatever_it_holds(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with suggest_shell_commands():
        command = suggested_call("resume", name, retry_failed=True).strip("`")
    words = shlex.split(command)
    assert words[:2] == ["sweep", "resume"] and words[3:] == ["--retry-failed"]
    assert words[2].removeprefix("./") == name
    if not name.startswith("-"):
        assert eval(suggested_call("resume", name)[len("`sweep.resume(") : -2]) == name


def test_commands_after_an_incomplete_run_work_for_a_path_with_blanks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = tmp_path / "my lidar.zarr"
    run_serially(small_spec(), store, scheduler="none", evaluate=fails)
    for arguments in (["status", store], ["resume", store, "--scheduler", "none"]):
        result = CliRunner().invoke(main, [*map(str, arguments)])
        assert f"sweep resume '{store}' --retry-failed" in result.output


def test_errors_of_the_command_suggest_commands_and_errors_in_python_suggest_calls(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    run_serially(small_spec(), "a b.zarr")
    with pytest.raises(StoreError, match=r"`sweep\.status\('.*a b\.zarr'\)` .*overwrite=True"):
        run_serially(small_spec(), "a b.zarr")
    with pytest.raises(StoreError, match=r"another store=, .*overwrite=True"):
        run_serially(small_spec(seed=4), "a b.zarr")
    with pytest.raises(StoreError, match=r"`sweep\.run\(spec, store=new\)`"):
        sweep.extend("a b.zarr", small_spec(seed=4), progress=False)
    (tmp_path / "study.yaml").write_text(json.dumps(small_mapping()))
    arguments = ("run", "study.yaml", "--store", "a b.zarr", "--scheduler", "none")
    assert "a b.zarr'` tells about it, --overwrite begins anew" in command_output(
        *arguments, exit_code=2
    )
    output = command_output("extend", "a b.zarr", "--set", "seed=4", exit_code=2)
    assert "`sweep run SPEC --store NEW`" in output
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"`sweep\.run\(spec, store=store\)`"):
        sweep.open("file")
    assert "`sweep run SPEC --store STORE`" in command_output("status", "file", exit_code=2)


def test_what_has_failed_before_is_tried_again_by_a_call_in_python(tmp_path):
    store = tmp_path / "a.zarr"
    assert run_serially(small_spec(), store).incomplete_reason == ""
    run_serially(small_spec(seed=4), tmp_path / "b.zarr", scheduler="none", evaluate=fails)
    outcome = sweep.resume(tmp_path / "b.zarr", progress=False, scheduler="none")
    assert outcome.incomplete_reason.endswith("retry_failed=True tries them again")


def test_functions_that_are_suggested_exist():
    for name in ("run", "resume", "extend", "status", "verify"):
        assert callable(getattr(sweep, name))
    assert issubclass(RunRequestError, Exception)
