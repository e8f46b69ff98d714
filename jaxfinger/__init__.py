"""jaxfinger: the dynamic model of a tendon-driven finger, from recordings, and why it still misses the bench."""

__version__ = "0.1.0"
