"""Benchmark of the diagnosis on sealed cases, whose true effect is withheld: makes, runs and scores them.

A departure is an effect of the plant that the nominal model lacks. The plant is MuJoCo's rigid body with laws in plain
NumPy. The room imports `jaxfinger.data` only, so that no code of the model or the catalogue under test makes the data.
"""
