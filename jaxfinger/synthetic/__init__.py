"""A simulated specimen on a simulated rig: it stands in for the bench, so it shares no assumption with the fit."""
