"""The names of `import jaxfinger as jf`, and how results show in a notebook."""

import doctest
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxfinger as jf
from jaxfinger.data.importing.by_mapping import import_file
from jaxfinger.identify.stages import identify
from jaxfinger.table import Table

DATASETS = Path(__file__).parents[1] / "datasets"
DEMO = DATASETS / "demo-finger" / "session.h5"


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    """Folder for the examples of docstrings: a real servo axis in `session.h5`, and its fit in `fit.json`."""
    folder = tmp_path_factory.mktemp("axis")
    import_file([DATASETS / "emps" / "DATA_EMPS.mat"], DATASETS / "emps" / "emps.toml", folder / "session.h5")
    jf.save(jf.identify(jf.read(folder / "session.h5"), jf.recipe("emps")), folder / "fit.json")
    return folder


SLOW = {"diagnose", "fit_many", "sensitivity"}  # their examples compile many programs


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long) if n in SLOW else n for n in jf.__all__], ids=str
)
def test_every_name_of_the_package_has_an_example_that_runs(name, axis, monkeypatch):
    monkeypatch.chdir(axis)
    thing = identify if name == "identify" else getattr(jf, name)  # the name is a callable package
    examples = doctest.DocTestParser().get_doctest(thing.__doc__ or "", {}, name, None, None)
    assert examples.examples
    said: list[str] = []
    failed, _ = doctest.DocTestRunner().run(examples, out=said.append)
    assert not failed, "".join(said)


def test_every_name_of_the_package_is_there_and_nothing_loads_jax_or_scipy_before_it_is_needed():
    code = "import sys, jaxfinger as jf; jf.read; jf.check; print({'jax', 'scipy'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
    assert all(getattr(jf, name) is not None for name in jf.__all__)
    assert callable(jf.identify)
    with pytest.raises(AttributeError, match=r"has no 'fit'; it has .*identify"):
        jf.fit  # noqa: B018


# In a process of its own: in this one the annotations are checked before.
MISTAKES = """
import jaxfinger as jf
session = jf.read({session!r})
fit = jf.identify(session, stages="ID.2")
for mistake in (
    lambda: jf.identify("session.h5"),
    lambda: jf.identify(session, "human-like"),
    lambda: jf.identify(session, stages=["ID.9"]),
    lambda: jf.refine(fit, session),
    lambda: jf.validate(session, fit),
    lambda: jf.validate(fit, session, "ID.3"),
    lambda: jf.predict(session, fit),
    lambda: jf.predict(fit, session, ["ID.2-MCP"]),
    lambda: jf.sensitivity(session, fit),
    lambda: jf.sensitivity(fit, session, "trial"),
    lambda: jf.fit_many(session, fit, session),
    lambda: jf.save("fit.json", fit),
    lambda: jf.write("session.h5", session),
    lambda: jf.write_predictions("p.h5", session, fit),
    lambda: jf.diagnose("session.h5"),
    lambda: jf.diagnose(session, against="fit.json"),
    lambda: jf.diagnose(session, tolerance="2%"),
    lambda: jf.diagnose(session, tolerance=dict(joint_torque="2%")),
    lambda: jf.diagnose(session, predictions="p.h5"),
    lambda: jf.diagnose(session, effects=[int]),
    lambda: jf.diagnose(session, without="tendon_strech"),
    lambda: session.with_trials(["ID.2-MCP"]),
    lambda: session.select("ID2"),
    lambda: session.select(joint="mcp"),
    lambda: jf.plot.budget(fit),
):
    try:
        mistake()
    except Exception as e:
        print(f"{{type(e).__name__}}: {{e}}")
"""


def test_a_mistake_in_an_argument_is_said_in_a_sentence():
    code = MISTAKES.format(session=str(DEMO))
    lines = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.splitlines()
    assert [re.split(r"[;(]", line)[0].strip() for line in lines] == [
        "UserError: session is of type str",
        "UserError: recipe is of type str",
        "UserError: there is no stage 'ID.9'",
        "UserError: session is of type Fit",
        "UserError: fit is of type Session",
        "UserError: there is no experiment 'ID.3'",
        "UserError: fit is of type Session",
        "UserError: there is no trial 'ID.2-MCP'",
        "UserError: fit is of type Session",
        "UserError: there is no kind of data 'trial'",
        "UserError: session 0 of those to fit is of type Trial",
        "UserError: fit is of type str",
        "UserError: session is of type str",
        "UserError: predictions is of type Fit",
        "UserError: session is of type str",
        "UserError: against is of type str",
        "UserError: tolerance is of type str",
        "UserError: tolerance of joint_torque: is '2%'",
        "UserError: predictions is of type str",
        "UserError: effects is of type list",
        "UserError: the catalogue has no effect tendon_strech to leave out",
        "UserError: there is no trial 'ID.2-MCP'",
        "UserError: there is no experiment 'ID2'",
        "UserError: there is no joint 'mcp'",
        "UserError: d is of type Fit",
    ]
    assert "give a Session (jf.read reads one)" in lines[0]
    assert "(did you mean '01-ID.2-MCP-a'?)" in lines[7]


def test_one_name_is_as_good_as_a_list_of_one():
    session = jf.read(DEMO, trials="01-ID.2-MCP-a")
    assert [*session.trials] == [*session.with_trials("01-ID.2-MCP-a").trials] == ["01-ID.2-MCP-a"]
    fit = jf.identify(session, stages="ID.2")
    assert [s.name for s in fit.stages] == ["ID.2"]
    assert jf.validate(fit, session, "ID.2").scores == jf.validate(fit, session, ("ID.2",)).scores


def test_the_page_of_the_api_has_every_name():
    page = (Path(__file__).parents[1] / "docs" / "api.md").read_text(encoding="utf-8")
    found = dict(re.findall(r"::: (\S+)\n    options:\n      heading: jf\.(\w+)", page))
    assert sorted(found.values()) == jf.__all__
    for path, name in found.items():
        thing = identify if name == "identify" else getattr(jf, name)
        assert pkgutil.resolve_name(path) is thing


def test_a_table_prints_and_says_which_columns_there_are():
    rows = Table([{"name": "q¹ <MCP>", "value": 0.012345678, "std": None}, {"name": "q²", "value": 2, "std": 0.5}])
    assert repr(rows).splitlines()[0].split() == ["name", "value", "std"]
    assert "0.01235" in repr(rows)
    assert "q¹ &lt;MCP&gt;" in rows._repr_html_()
    assert rows.column("std") == [None, 0.5]
    with pytest.raises(KeyError, match=r"no column 'sd'; there are name, value, std"):
        rows.column("sd")


def test_a_session_shows_itself_in_a_line_and_says_which_trials_there_are():
    session = jf.read(DEMO)
    assert repr(session).startswith("Session('demo finger': 3 joints, 5 tendons; ")
    assert len(repr(session)) < 200
    trial = next(iter(session))
    assert repr(trial).startswith(f"Trial({trial.name!r}: ID.2")
    assert session.table().column("trial") == list(session.trials)
    assert "<table>" in session._repr_html_()
    with pytest.raises(KeyError, match=f"no trial 'x'; there are {trial.name}"):
        session["x"]
