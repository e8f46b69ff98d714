"""Sizes of a session: spikes in single samples change none of them."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data.signals.sizes import sizes_of


@pytest.mark.parametrize("share", [0.005, 0.02])
def test_spikes_make_no_machine_quicker_or_stronger(session, share):
    """A share of single samples in angles and tensions is off by half of the channel's range."""
    rng = np.random.default_rng(0)

    def thrown(x):
        return None if x is None else x + 0.5 * np.nanmax(np.abs(x), initial=0.0) * (rng.random(x.shape) < share)

    def spiked(trial):
        return replace(trial, q=thrown(trial.q), tendon_force=thrown(trial.tendon_force))

    found = sizes_of(replace(session, trials={t.name: spiked(t) for t in session}))
    sound = sizes_of(session)
    assert (found.pace, found.slow_pace) == (sound.pace, sound.slow_pace) == (1.0, 1.0)
    assert found.tension < 1.5 * sound.tension
    assert found.noise < 1.5 * sound.noise
