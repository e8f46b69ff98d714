"""Findings for people: one line for a fault that trials share, and a subject in every sentence."""

import pytest

from jaxfinger.cli import main
from jaxfinger.data.findings import Report, merged
from jaxfinger.data.finger_file import finger_from
from jaxfinger.data.toml import Place
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT


def test_what_trials_have_in_common_is_said_once():
    report = Report()
    for k in range(6):
        report.warning(f"/trials/{k:02d}-ID.2/time", f"has 1 gap, the longest {0.1 * k:.3g} s; derivatives bridge it")
    report.warning("/trials/00-ID.2/q", "has 1 gap, the longest 0.1 s; derivatives bridge it")
    report.warning("/trials/01-ID.4/tendon_force", "tendon T1 is never pulled")
    report.warning("/trials/02-ID.4/tendon_force", "tendon T2 is never pulled")
    report.error("/", "is empty")
    report.error("/", "is empty")
    gaps, *others = merged(report)
    assert gaps.place == "/trials/00-ID.2/time"
    assert gaps.message.endswith("bridge it (likewise in 5 other trials: 01-ID.2, 02-ID.2, 03-ID.2 and 2 more)")
    assert others == report[6:]


@pytest.mark.parametrize(
    ("place", "kind", "name"),
    [
        ("/trials/{}/q", "trial", "0{}-ID.2"),
        ("trials.{}.channels.q.MCP", "trial", "0{}-ID.2-a"),
        ("trials.{}.time", "trial", "0{}-ID.2.a"),
        ("trials.{}", "trial", "0{}"),
        ("logs/{}", "recording", "log {}.csv"),
        ("logs/{}", "recording", "log {}.lvm"),
        ("/home/{}", "recording", "log-{}.MAT"),
        ("C:\\logs\\{}", "recording", "{}.mcap"),
    ],
)
def test_findings_are_merged_at_every_kind_of_place(place, kind, name):
    report = Report()
    names = [name.format(k) for k in range(5)]
    for k, called in enumerate(names):
        report.warning(place.format(called), f"states {k} units")
    report.warning("finger.mass", "states 3 units")
    found, other = merged(report)
    said = f"states 0 units (likewise in 4 other {kind}s: {', '.join(names[1:4])} and 1 more)"
    assert (found.place, found.message) == (place.format(names[0]), said)
    assert other == report[-1]


def test_findings_of_no_trial_are_not_merged():
    report = Report()
    for place in ("/", "/trials", "/finger/mass", "channels.q.MCP", "finger.joints[0]"):
        report.warning(place, "is empty")
        report.warning(place, "is empty")
    assert merged(report) == report


def test_what_is_wrong_with_the_whole_file_has_it_as_its_subject(tmp_path, capsys):
    file = tmp_path / "s.h5"
    file.write_bytes(b"")
    with pytest.raises(SystemExit):
        main(["check", str(file)])
    assert f"error: {file}: is empty" in capsys.readouterr().out.replace("\n", " ")


def test_what_is_wrong_with_a_link_leads_to_its_line(tmp_path):
    file = tmp_path / "finger.toml"
    file.write_text(ONE_JOINT.replace("4e-6, 0.0]", "9e-6, 0.0]"))
    line = 1 + file.read_text()[: file.read_text().index("inertia")].count("\n")
    with pytest.raises(
        UserError, match=rf"\.toml, line {line}: finger\.joints\[0\]\.inertia: the link of joint MCP has"
    ):
        finger_from(str(file), Place("mapping.toml"))
