"""What the name of a column says: its channel, whose it is, and whether it is measured at all."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from jaxfinger.data.importing.stamps import coarse_rate
from jaxfinger.data.units import TO_SI, spelt_unit, unit_name, weight_unit, without_units

# Patterns of names for each channel, of which the first that fits counts: common words in logs of robots.
_MEANINGS = (
    (
        "time",
        r"^t(_?(s|sec|ms|us|ns))?$|time|stamp|clock|zeit|^sec|^duration$|^epoch|^elapsed|^utc|^(milli|micro)s$"
        r"|^temps$|^tiempo|^tempo$|[时時][间間]",
    ),
    ("temperature", r"temp"),
    ("joint_torque", r"(^|_)tau|torque|effort|moment|^couple|力矩|扭矩|トルク|joint[_ ]?\d*[_ ]?force"),
    ("tendon_excursion", r"excursion|^l\d*$|length|(?<![a-z])len(?![a-z])|pull|spool|linear|travel"),
    (
        "tendon_force",
        r"tension|tendon.*force|^f_?t|^f(\d|_(?!([xyz](_|\d|$)|tip$)))|cable|load[ _-]?cell|(^|_)cell(_|\d|$)"
        r"|^force(?![ _-]?[xyz]$)|kraft$|^fuerza|^forza|[张張]力",
    ),
    ("fingertip_force", r"f?tip|contact|(?<![a-z])(f|force)[ _-]?[xyz]$|wrench"),
    ("q", r"^q[_\d]*|_q(_|\d|$)|angle|pos|enc|theta|winkel|[aá]ngulo|angolo|角度|deg$"),
)
# Of a clock's values or steps: more values differ, also out of order, or more steps go on, also of a recording that was
# pasted twice.
_MIN_RUNNING = 0.5
_NO_WORDS = "value", "data"  # at the end of a name, which say nothing of what they are: the word before them does
# Name of the time since the sample before.
_TIME_STEP = r"[dΔδ∆]_?t|(delta|diff|step|cycle|loop)_?t(ime)?|t(ime)?_?(delta|diff|step)"
_TIME_STEP += r"|(time|sample|sampling)_?(interval|period)"
# Name of a column of a table without names, or one that says no more: programs that draw curves call times x.
_NAMELESS = r"column \d+|x([ _-]?(value|axis)s?)?"
# Names of velocities, which belong to no channel, of set-points, which are not measured, and of switches and states.
_VELOCITY = r"(?<![a-z])q?(vel|acc)|speed|(?<![a-z])rpm|dot|^v$|^dq|(^|_)(d+(q|theta)|(q|theta)d+)(_|\d|$)"
_STATE = r"enable|flag|status|valid|(^|_)(on|off|ok|mode|err|error|fault|alarm)(_|\d|$)|collision|joint_contact"
_SET_POINT = (
    r"cmd|command|cmptd|computed|ref(?!l)|desired|set_?p(oin)?t|goal|target|demand|soll|feed_?forward"
    r"|(?<![a-z])d*(q|theta|tau|tau_j)_d(?![a-z])"
    r"|(?<![a-z])(q|tau|pos)?(des|set(?!\d+\.)|sp|ff|tgt|nominal|planned)(?![a-z])"
)
# Names of what is in front of a joint's gear or spring, and of positions as drives and encoders count them.
MOTOR = r"(?<![a-z])(motor|mot|drive|actuator|rotor|spool|winch)(?![a-z])"
_ELECTRIC = r"(?<![a-z])(current|curr|strom|i_?q|pwm|duty(_?cycle)?|rpm|v_?bus|bus_?voltage)(?![a-z])"
_OF_DRIVE = r"pos_?(estimate|cpr|circular)|odrv|odrive|moteus"
_POSITION = r"(?<![a-z])(pos(ition)?|enc(oder)?)(?![a-z])"
_SI_UNITS = {
    "time": ("s",),
    "temperature": ("K",),
    "joint_torque": ("N m", "N"),
    "tendon_excursion": ("m",),
    "tendon_force": ("N",),
    "fingertip_force": ("N",),
    "q": ("rad", "m"),
}
_CHANNEL_OF_UNITS = {"rad": "q", "N m": "joint_torque", "N": "tendon_force", "m": "tendon_excursion"}
_FORCES = "tendon_force", "fingertip_force"
# Anatomical names of a finger's joints, for logs of which no finger is known.
_JOINTS = "cmc", "mcp", "mp", "pip", "dip", "ip"


class Owners:
    """Names of joints and tendons, which say whose a column is and not what it holds."""

    def __init__(self, joints: Sequence[str], tendons: Sequence[str]):
        self.joints = [words(name) for name in joints or _JOINTS]
        self.tendons = [words(name) for name in tendons]

    def of(self, text: str) -> tuple[str, str]:
        """The longest name that a text holds as a word, or none, and the text without it."""
        held = max((n for n in (*self.joints, *self.tendons) if as_word(n).search(text)), key=len, default="")
        return held, as_word(held).sub("", text, count=1).strip(" _-") if held else text


def words(name: str) -> str:
    """A name in small letters, with a mark where a capital begins a word."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower()


def as_word(name: str) -> re.Pattern[str]:
    """Pattern of a name as one word or several."""
    return re.compile(rf"(?<![a-z0-9]){re.escape(name)}(?![a-z0-9])")


def is_nameless(name: str) -> bool:
    """Whether a column has no name in its recording, so that its values alone say what it may be."""
    return re.fullmatch(_NAMELESS, name.lower()) is not None


def is_of_tendon(name: str) -> bool:
    """Whether a name says that a force is a tendon's, or one of several forces by its number."""
    return re.search(r"tension|tendon|cable|[张張]力|\d", words(name)) is not None


def is_before_a_gear(name: str) -> bool:
    """Whether a column is of a motor by its name, so that a gear may be between it and the joint."""
    return re.search(f"{MOTOR}|{_OF_DRIVE}", words(name)) is not None


def is_electric(name: str) -> bool:
    """Whether a column is of a drive by its name: its current, duty cycle or voltage, or the speed of its motor."""
    return re.search(_ELECTRIC, words(name)) is not None


def is_position(name: str) -> bool:
    """Whether a name says no more than that a drive or an encoder counts a position: not that it is a joint's angle."""
    return re.search(_POSITION, words(name)) is not None and "joint" not in name.lower()


def is_speed(name: str) -> bool:
    """Whether a column may hold speeds by its name; one without a name may hold anything."""
    return is_nameless(name) or re.search(_VELOCITY, name.lower()) is not None


def is_time_step(name: str, x: np.ndarray) -> bool:
    """Whether a column holds the times between samples in place of times: by its name, and since it goes up and down
    as often, or stays the same, where a clock goes on."""
    word = re.sub(r"_(s|sec|ms|us|ns)$", "", words(re.split(r"[./]", without_units(name))[-1]))
    if x.ndim > 1 or re.fullmatch(_TIME_STEP, word) is None:
        return False
    x = x[1:][np.isfinite(x[1:])]  # The first sample has none before it.
    if np.any(x < 0.0) or not np.any(x > 0.0):
        return False
    ups, downs = (np.count_nonzero(sign * np.diff(x) > 0.0) for sign in (1.0, -1.0))
    return bool(ups <= 2 * downs)


def is_clock(name: str, x: np.ndarray, stated: str) -> bool:
    """Whether a column with these values and stated units holds times, by its name."""
    return x.ndim == 1 and meaning_of(name, None, x, stated, Owners((), ()))[0] == "time"


def meaning_of(name: str, column: str | int | None, x: np.ndarray, stated: str, owners: Owners) -> tuple[str, str]:
    """Channel or `time` by the last word of a name where its units allow it, else by these; and the units, if any.

    Both are empty where they are unclear. A joint's or tendon's name says nothing of the channel: the words beside it,
    or before it, do. A force that is stated in g or kg is a weight.
    """
    units = unit_name(stated) or spelt_unit(name)
    *before, word = re.split(r"[./]", without_units(name))
    word = before.pop() if before and word.lower() in _NO_WORDS else word
    word = re.sub(r"(?<=[a-zA-Z0-9])_[Nm]$", "", word)  # newtons; metres or «measured»
    owner, rest = owners.of(words(word))
    rest = rest or (words(before[-1]) if before else "")
    texts = [word.lower(), *([f"{rest}_{owner}", rest] if owner and rest else [])]
    if (
        len(x) == 1
        or is_set_point(name)
        or is_time_step(name, x)
        or any(re.search(p, text) for p in (_VELOCITY, _STATE) for text in texts)
    ):
        return "", units
    found = next((m for text in texts if (m := _channel(text, units, text == texts[0]))), "")
    if found == "time":
        shares = (len(np.unique(x)) / len(x), np.mean(np.diff(x) > 0.0)) if len(x) > 2 else (0.0,)
        runs = max(shares) > _MIN_RUNNING or coarse_rate(x) is not None
        return "time" if column is None and runs else "", units
    if not units and (found in _FORCES or owner in owners.tendons):
        units = weight_unit(stated)
    return found or (_CHANNEL_OF_UNITS.get(TO_SI[units].si, "") if units else ""), units


def _channel(text: str, units: str, whole: bool) -> str:
    """Channel that a text names, or `time` where it is the whole of a word; empty where it names none."""
    fitting = [m for m, pattern in _MEANINGS if re.search(pattern, text) and (whole or m != "time")]
    return next((m for m in fitting if not units or TO_SI[units].si in _SI_UNITS[m]), "")


def is_joint(name: str, owners: Owners) -> bool:
    """Whether a name is a joint's and nothing more."""
    return words(without_units(name)) in owners.joints


def is_set_point(name: str) -> bool:
    """Whether a variable's name, or that of a structure which holds it, says that it is a set-point."""
    return re.search(_SET_POINT, words(without_units(name).split("/")[-1])) is not None
