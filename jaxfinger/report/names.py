"""Names in words: of effects, sites and causes, of channels and of the variables that a gap depends on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from jaxfinger.effects import Site
from jaxfinger.gap.result import Cause, Key

CHANNEL_NAMES = {
    "joint_torque": "joint torque",
    "tendon_excursion": "tendon excursion",
    "fingertip_force": "fingertip force",
    "tendon_force": "tendon force",
    "q": "simulated angle",
}
# Sites that the catalogue names, where a name has two words; the others are the user's own names.
SITE_NAMES = {s: s.replace("_", " ") for s in ("torque_sensor", *(c for c in CHANNEL_NAMES if "_" in c))}
VARIABLE_NAMES = {
    "q": "the joint's own position",
    "qd": "speed",
    "direction": "the direction of motion",
    "tension": "tension",
    "tendon_force": "tension",
    "distance since reversal": "the distance since the last reversal",
    "time": "time",
    "other joints": "the other joints' positions",
}


def effect_name(effect: str) -> str:
    """Name of an effect: `tendon_stretch` gives «tendon stretch», `changed_damping` «a change of damping»."""
    return effect.replace("changed_", "a change of ").replace("_", " ").replace("stribeck", "Stribeck")


def channel_name(channel: str) -> str:
    """Name of a channel: `joint_torque` gives «joint torque»."""
    return CHANNEL_NAMES.get(channel, channel.replace("_", " "))


def site_names(sites: Iterable[Site]) -> str:
    """Names of sites: «T3», «T3 and T4», «MCP-PIP», «torque sensor»."""
    return joined(["-".join(SITE_NAMES.get(name, name) for name in s) for s in sites])


def key_name(key: Key) -> str:
    """Name of a cause and its site: «tendon stretch at T3»."""
    return f"{effect_name(key.effect)} at {site_names([key.site])}"


def cause_name(cause: Cause) -> str:
    """Name of a cause and all its sites: «tendon stretch at T3 and T4»."""
    return f"{effect_name(cause.effect)} at {site_names(cause.sites)}"


def joined(parts: Sequence[str], word: str = "and") -> str:
    """Join parts as a list in a sentence: «a», «a and b», «a, b and c»."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} {word} {parts[-1]}" if parts else ""
