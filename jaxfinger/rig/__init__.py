"""The hardware adapter: channels, safety, experiment protocols, recorder; for TwinCAT, replay and simulation."""

from jaxfinger.rig.backend import Block as Block
from jaxfinger.rig.backend import Rig as Rig
from jaxfinger.rig.backend import RigError as RigError
from jaxfinger.rig.backend import Status as Status
from jaxfinger.rig.backends import open_rig as open_rig
from jaxfinger.rig.channels import RigDescription as RigDescription
from jaxfinger.rig.plan import Plan as Plan
from jaxfinger.rig.plan import estimate as estimate
from jaxfinger.rig.plan import parse_plan as parse_plan
from jaxfinger.rig.plan import read_plan as read_plan
from jaxfinger.rig.recover import recover as recover
from jaxfinger.rig.rig_file import parse_rig as parse_rig
from jaxfinger.rig.rig_file import read_rig as read_rig
from jaxfinger.rig.safety import Supervisor as Supervisor
from jaxfinger.rig.session import Outcome as Outcome
from jaxfinger.rig.session import run as run
