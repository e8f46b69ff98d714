"""A simulated specimen on a simulated rig. It stands in for the bench, so it shares no assumption with the fit."""

from jaxfinger.synthetic.fingers import polynomial_finger as polynomial_finger
from jaxfinger.synthetic.fingers import specimen_of as specimen_of
from jaxfinger.synthetic.fingers import study_finger as study_finger
from jaxfinger.synthetic.fingers import true_model as true_model
from jaxfinger.synthetic.model_plant import ModelPlant as ModelPlant
from jaxfinger.synthetic.paper_finger import paper_finger as paper_finger
from jaxfinger.synthetic.plant import Plant as Plant
from jaxfinger.synthetic.plant import SpecimenPlant as SpecimenPlant
from jaxfinger.synthetic.protocols import TrialPlan as TrialPlan
from jaxfinger.synthetic.protocols import session_plan as session_plan
from jaxfinger.synthetic.random_finger import random_finger as random_finger
from jaxfinger.synthetic.recipe import SHORT as SHORT
from jaxfinger.synthetic.recipe import SessionRecipe as SessionRecipe
from jaxfinger.synthetic.recipe import read_session_recipe as read_session_recipe
from jaxfinger.synthetic.recipe import recipe_from as recipe_from
from jaxfinger.synthetic.simulate import CleanSession as CleanSession
from jaxfinger.synthetic.simulate import clean_session as clean_session
from jaxfinger.synthetic.simulate import measure as measure
from jaxfinger.synthetic.simulate import simulate as simulate
from jaxfinger.synthetic.simulate import simulate_many as simulate_many
from jaxfinger.synthetic.specimen import Specimen as Specimen
