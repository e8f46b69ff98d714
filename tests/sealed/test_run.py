"""Runs of a diagnosis over cases: sealed, resumable, in shares."""

import json
import os
import sys

import h5py
import numpy as np
import pytest

from jaxfinger.cli import sealed as cli
from jaxfinger.errors import UserError
from jaxfinger.sealed import run as run_module
from jaxfinger.sealed.run import Command, Predict, close_cases, run_case, run_cases
from jaxfinger.sealed.score import imitators

READ = "import sys, json, pathlib; o = pathlib.Path(sys.argv[2]); o.mkdir(); "


@pytest.fixture
def folder(tmp_path):
    for i in range(1, 6):
        case = tmp_path / "cases" / f"case-{i:03d}"
        case.mkdir(parents=True)
        (case / "fit.h5").write_text(f"session {i}")
        (case / "fresh.h5").write_text("not to be seen")
        (case / "truth.json").write_text("not to be seen")
    return tmp_path / "cases"


def diagnose(fit, out):
    """Stand in for a diagnosis: write down what it can see."""
    out.mkdir()
    if fit.read_text() == "session 4":
        raise ValueError("cannot")
    (out / "gap.json").write_text(
        json.dumps({"saw": sorted(p.name for p in fit.parent.rglob("*") if p.is_file()), "read": fit.read_text()})
    )


def test_the_diagnosis_sees_the_session_alone(folder, tmp_path):
    assert run_case(diagnose, folder / "case-001", tmp_path / "out") == "done"
    assert json.loads((tmp_path / "out" / "case-001" / "gap.json").read_text()) == {
        "saw": ["fit.h5"],
        "read": "session 1",
    }


def test_failures_are_kept_and_finished_cases_skipped(folder, tmp_path):
    told = []
    results = run_cases(folder, tmp_path / "out", diagnose, progress=lambda *a: told.append(a))
    assert results == {
        "case-001": "done",
        "case-002": "done",
        "case-003": "done",
        "case-004": "failed",
        "case-005": "done",
    }
    assert [t[0] for t in told] == [1, 2, 3, 4, 5]
    record = json.loads((tmp_path / "out" / "case-004" / "run.json").read_text())
    assert record["error"] == "ValueError: cannot"
    assert record["seconds"] >= 0
    assert set(run_cases(folder, tmp_path / "out", diagnose).values()) == {"skipped"}


def test_shares_are_a_partition_and_workers_agree(folder, tmp_path):
    one = run_cases(folder, tmp_path / "a", diagnose, share=(1, 2))
    two = run_cases(folder, tmp_path / "b", diagnose, share=(2, 2))
    assert not set(one) & set(two)
    assert len(one) + len(two) == 5
    copy = f"{READ}(o / 'gap.json').write_text(pathlib.Path(sys.argv[1]).read_text())"
    command = Command(f'{sys.executable} -c "{copy}" {{fit}} {{out}}')
    assert set(run_cases(folder, tmp_path / "c", command, workers=2).values()) == {"done"}
    assert (tmp_path / "c" / "case-004" / "gap.json").read_text() == "session 4"


def test_a_command_that_fails_says_why(folder, tmp_path):
    command = Command(f"{sys.executable} -c \"import sys; sys.exit('no tendon')\" {{fit}} {{out}}")
    assert run_case(command, folder / "case-001", tmp_path / "out") == "failed"
    assert "no tendon" in json.loads((tmp_path / "out" / "case-001" / "run.json").read_text())["error"]


def test_the_commands_say_what_to_do(folder, tmp_path, capsys):
    with pytest.raises(UserError, match="no case here"):
        run_cases(tmp_path / "nothing", tmp_path / "out", diagnose)
    with pytest.raises(UserError, match=r"\{fit\}"):
        cli.run(folder, command="diagnose this")
    with pytest.raises(UserError, match="no diagnoses here"):
        cli.score(folder)
    with pytest.raises(UserError, match="i/n"):
        cli.make(tmp_path / "new", share="half")
    verdict = (
        "verdict=dict(status='no_gap', effects=[]), none=1.0, unlisted=0.0, candidates=[], ambiguous_sets=[], budget=[]"
    )
    script = f"{READ}(o / 'gap.json').write_text(json.dumps(dict({verdict})))"
    cli.run(folder, command=f'{sys.executable} -c "{script}" {{fit}} {{out}}', workers=1)
    for case in folder.iterdir():
        (case / "truth.json").write_text(json.dumps({"effects": []}))
    cli.score(folder, output=tmp_path / "scores")
    assert "false alarm" in capsys.readouterr().out
    saved = json.loads((tmp_path / "scores" / "scores.json").read_text())
    assert saved["figures"]["false alarm"] == pytest.approx(
        {"value": 0.0, "low": 0.0, "high": 0.434, "count": 5}, abs=1e-3
    )
    assert (tmp_path / "scores" / "reliability.svg").exists()


def test_withheld_effects_are_taken_out_one_by_one(folder, capsys):
    effects = {"case-001": ["payload"], "case-002": ["payload"], "case-003": ["channel_delay"], "case-004": []}
    effects["case-005"] = ["payload", "channel_delay"]
    for name, found in effects.items():
        truth = {"effects": [{"effect": e, "site": ["DIP"], "listed": True} for e in found]}
        (folder / name / "truth.json").write_text(json.dumps(truth))
    # This diagnosis names a drive's inertia where the payload is withheld, and «unexplained» otherwise.
    says = "lacks = sys.argv[sys.argv.index('--without') + 1]; named = [dict(effect='drive_inertia', site=['DIP'])]; "
    verdict = (
        "dict(status='explained', effects=named) if lacks == 'payload' else dict(status='unexplained', effects=[])"
    )
    rest = "none=0.0, unlisted=0.0, candidates=[], ambiguous_sets=[], budget=[]"
    script = f"{READ}{says}(o / 'gap.json').write_text(json.dumps(dict(verdict={verdict}, {rest})))"
    line = f'{sys.executable} -c "{script}" {{fit}} {{out}}'
    cli.run(folder, command=line, withheld=True, workers=1)
    assert "3 diagnosed" in capsys.readouterr().out
    delay, payload = imitators(folder, folder.with_name("cases-withheld"), None)
    assert (delay.effect, delay.unexplained.value, delay.answers) == ("channel_delay", 1.0, [])
    assert (payload.effect, payload.unexplained.value, payload.no_gap) == ("payload", 0.0, 0)
    assert payload.answers == [("drive_inertia (DIP)", 2)]


def test_fresh_trials_are_predicted_where_a_known_effect_is_there_and_by_a_refit_with_it(folder, tmp_path, monkeypatch):
    seen = {}

    def rows(fresh, predictions):
        seen[fresh.parent.name] = {name: file.read_text() for name, file in predictions.items()}
        return [{"before": 1.0}]

    monkeypatch.setattr("jaxfinger.sealed.closure.fresh_rows", rows)
    payload, delay = {"effect": "payload", "site": ["DIP"]}, {"effect": "channel_delay", "site": ["q"]}
    says = {"case-001": (payload, payload), "case-002": (delay, payload), "case-003": (None, payload)}
    says |= {"case-004": (payload, None)}
    for name, (named, true) in says.items():
        truth = {"effects": [true | {"listed": True}] if true else []}
        (folder / name / "truth.json").write_text(json.dumps(truth))
        out = tmp_path / "out" / name
        out.mkdir(parents=True)
        verdict = {"status": "explained" if named else "no_gap", "effects": [named] if named else []}
        gap = {"verdict": verdict, "candidates": [], "none": 0.0, "unlisted": 0.0, "ambiguous_sets": [], "budget": []}
        (out / "gap.json").write_text(json.dumps(gap))
        (out / "nominal.json").write_text("nominal")
        (out / "augmented.json").write_text("augmented")
    copies = f"{sys.executable} -c 'import sys; a = sys.argv; open(a[3], \"w\").write(open(a[1]).read())'"
    writes = f"{sys.executable} -c 'import sys; a = sys.argv; open(a[-1], \"w\").write(str(a[2:-1]))'"
    predict = Predict(f"{copies} {{fit}} {{session}} {{out}}", f"{writes} {{session}} {{effects}} {{out}}")
    done = close_cases(folder, tmp_path / "out", predict, None)
    assert done == {"case-001": "done", "case-002": "done", "case-003": "done", "case-004": "skipped"}
    assert seen["case-001"] == {"before": "nominal", "after": "augmented", "best": "augmented"}
    assert seen["case-002"] == {"before": "nominal", "after": "augmented", "best": "['payload:DIP']"}
    assert seen["case-003"]["best"] == "['payload:DIP']"  # The true effect is not named, and is refitted.
    assert json.loads((tmp_path / "out" / "case-001" / "fresh.json").read_text()) == {"rows": [{"before": 1.0}]}
    assert close_cases(folder, tmp_path / "out", predict, None)["case-001"] == "skipped"
    (tmp_path / "out" / "case-001" / "fresh.json").unlink()
    broken = Predict(f"{sys.executable} -c 'exit(1)'")
    assert close_cases(folder, tmp_path / "out", broken, None)["case-001"] == "failed"
    assert "exit status 1" in (tmp_path / "out" / "case-001" / "close.log").read_text()


def test_cases_of_like_fingers_follow_one_another(tmp_path):
    crosses = {1: [[True, False]], 2: [[True, True]], 3: [[True, False]], 4: [[True, False], [True, True]]}
    for i, matrix in crosses.items():
        case = tmp_path / "cases" / f"case-{i:03d}"
        case.mkdir(parents=True)
        with h5py.File(case / "fit.h5", "w") as f:
            f["finger/tendons/crosses"] = np.array(matrix)
    run_cases(tmp_path / "cases", tmp_path / "out", diagnose)
    records = sorted((tmp_path / "out").glob("*/run.json"), key=lambda f: f.stat().st_mtime_ns)
    order = [f.parent.name for f in records]
    assert abs(order.index("case-001") - order.index("case-003")) == 1


def test_processes_serve_several_cases_and_end(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(run_module, "CASES_PER_PROCESS", 1)
    results = run_cases(folder, tmp_path / "out", diagnose, workers=2)
    assert results["case-004"] == "failed"
    assert sorted(results) == [f.name for f in sorted(folder.iterdir())]


def ended(fit, out):
    """End as a process that takes all of the memory."""
    os._exit(9)


def test_a_process_that_the_system_ends_is_a_sentence(folder, tmp_path):
    with pytest.raises(UserError, match="the system ended a process while case-"):
        run_cases(folder, tmp_path / "out", ended)


@pytest.mark.long
def test_this_programs_own_diagnosis_runs_in_processes_of_their_own_and_says_what_it_refused(folder, tmp_path, capsys):
    cli.run(folder, workers=2)
    said = capsys.readouterr().out
    assert "0 diagnosed; failed, see run.json: case-001" in said.replace("\n", "")
    record = json.loads((tmp_path / "cases-diagnoses" / "case-001" / "run.json").read_text())
    assert record["error"].startswith("UserError: ")
    assert "not an HDF5 file" in record["error"]
