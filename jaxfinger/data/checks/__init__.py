"""Checks of a session: values, units, signs, names and clocks that contradict physics, the finger or each other."""
