"""A test bench for the adapter: simulated controller, finger and ADS server. It shares only the contract with it."""
