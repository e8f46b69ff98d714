"""The simulated controller, its finger and its ADS server: a bench to try the adapter on, which knows nothing of it."""
