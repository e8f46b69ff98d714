"""The benchmark of the diagnosis on data whose effect is withheld: makes, runs and scores sealed cases.

It imports `jaxfinger.data` only. The plant is MuJoCo's rigid body with laws in plain NumPy, so that nothing of the
model or of the catalogue under test is in the data.
"""
