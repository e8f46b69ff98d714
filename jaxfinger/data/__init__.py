"""Sessions: read, write and check the HDF5 format; filtering, derivatives, directions, holds."""

from jaxfinger.data.check import check_file as check_file
from jaxfinger.data.filtering import bridged as bridged
from jaxfinger.data.filtering import filter_std as filter_std
from jaxfinger.data.filtering import filtered_noise_std as filtered_noise_std
from jaxfinger.data.filtering import longest_spike as longest_spike
from jaxfinger.data.filtering import low_pass as low_pass
from jaxfinger.data.filtering import outlier_mask as outlier_mask
from jaxfinger.data.filtering import smooth as smooth
from jaxfinger.data.filtering import without_spikes as without_spikes
from jaxfinger.data.findings import Finding as Finding
from jaxfinger.data.hdf5 import data_hash as data_hash
from jaxfinger.data.hdf5 import read_session as read_session
from jaxfinger.data.hdf5 import write_session as write_session
from jaxfinger.data.motion import directions as directions
from jaxfinger.data.motion import directions_from_turning_points as directions_from_turning_points
from jaxfinger.data.motion import find_holds as find_holds
from jaxfinger.data.predictions import Predictions as Predictions
from jaxfinger.data.predictions import read_predictions as read_predictions
from jaxfinger.data.predictions import write_predictions as write_predictions
from jaxfinger.data.session import EXPERIMENT_NAMES as EXPERIMENT_NAMES
from jaxfinger.data.session import FingerDescription as FingerDescription
from jaxfinger.data.session import Session as Session
from jaxfinger.data.session import Trial as Trial
from jaxfinger.data.session import joints_of as joints_of
from jaxfinger.data.session import moving_joints as moving_joints
