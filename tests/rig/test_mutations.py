"""Mutated rig and plan files are read, or refused with the line."""

from hypothesis import HealthCheck, given, settings

from jaxfinger.rig import parse_plan, parse_rig
from jaxfinger.rig.simulated.examples import rig_toml
from tests.mutations import assert_read_or_refused, mutated

PLAN = """[plan]
name = "p"
[[trial]]
experiment = "ID.2"
joint = "MCP"
repeats = 2
share = 0.5
[[trial]]
experiment = "ID.4"
tendon = "T3"
joint = "MCP"
levels = [3.0, 6.0]
posture_deg = [25.0, 60.0, 20.0]
down = false
[[trial]]
experiment = "ID.3-static"
joint = "PIP"
range_deg = [0.0, 40.0]
step_deg = 10.0
[[trial]]
experiment = "VD.3"
mean = [4.0, 2.5, 3.0, 3.0]
amplitude = 0.5
seconds = 1.0
"""


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(text=mutated(PLAN))
def test_a_mutated_plan_is_read_or_refused(rig, text):
    assert_read_or_refused(lambda text: parse_plan(text, rig, "mutated.toml"), text)


@settings(max_examples=100, deadline=None)
@given(text=mutated(rig_toml()))
def test_a_mutated_rig_file_is_read_or_refused(text):
    assert_read_or_refused(lambda text: parse_rig(text, "mutated.toml"), text)
