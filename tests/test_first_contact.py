"""The script `.ci/gpu`: whatever becomes of a step, the others run and the report says how it went."""

import runpy
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / ".ci" / "gpu"


@pytest.fixture
def gpu(tmp_path, monkeypatch):
    """Runs the script with steps of a test's own, by name: the code of each, and what it needs."""

    def run(steps, *options):
        script = runpy.run_path(str(SCRIPT))
        folder = tmp_path / "modules"
        folder.mkdir(exist_ok=True)
        for name, (code, _) in steps.items():
            (folder / f"step_{name}.py").write_text(code)
        table = {name: (f"step_{name}", needs) for name, (_, needs) in steps.items()}
        monkeypatch.setattr(sys, "argv", ["gpu", "--out", str(tmp_path / "out"), *options])
        monkeypatch.setenv("PYTHONPATH", str(folder))
        script["main"].__globals__.update(STEPS=table, machine=lambda: "a machine")
        return script["main"](), (tmp_path / "out" / "report.md").read_text()

    return run


def test_a_step_that_fails_does_not_stop_the_others(gpu, tmp_path):
    steps = {
        "bad": ("print('before'); raise SystemExit(3)", ""),
        "good": ("print('1 of 2\\r2 of 2: all is well')", "pytest"),
        "poor": ("", "pytest no_such_package no-such-program"),
    }
    code, report = gpu(steps)
    assert code == 1
    assert "a machine" in report
    results = {row.split(" | ")[0][2:]: row.split(" | ")[1] for row in report.splitlines() if row.startswith("| ")}
    assert results["bad"] == "failed: exit status 3"
    assert results["good"] == "passed"
    assert results["poor"] == "skipped: needs no_such_package, no-such-program"
    assert "2 of 2: all is well" in report
    assert "1 of 2" not in report  # of a progress bar the end
    assert "before" in (tmp_path / "out" / "log.txt").read_text()
    assert gpu(steps, "good", "poor")[0] == 0


def test_a_step_that_hangs_is_stopped(gpu):
    code, report = gpu({"slow": ("import time; time.sleep(60)", ""), "late": ("", "")}, "--minutes", "0.2")
    assert code == 1
    assert "| slow | failed: out of time |" in report
    assert "| late | passed |" in report


def test_asked_to_stop_it_ends_its_steps_and_writes_the_report(tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen([sys.executable, SCRIPT, "--out", out, "ops", "bench-ops"], stdout=subprocess.DEVNULL)
    while not (out / "log.txt").exists():
        time.sleep(0.1)
    time.sleep(1)  # in the midst of the first step
    process.terminate()
    assert process.wait(timeout=60) == 1
    report = (out / "report.md").read_text()
    assert "| ops | failed: exit status" in report
    assert "| bench-ops | failed: out of time before it began |" in report


def test_every_step_names_tests_and_commands_that_exist():
    from ilnet.commands.cli import cli

    for arguments, _ in runpy.run_path(str(SCRIPT))["STEPS"].values():
        words = shlex.split(arguments)
        if words[0] == "pytest":
            assert (SCRIPT.parents[1] / next(word for word in words if word.startswith("tests/"))).exists()
        else:
            assert words[words.index("ilnet") + 1] in cli.commands
