"""Links whose lengths, masses and inertias contradict each other are named, and sound fingers and arms are not."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import FingerDescription
from jaxfinger.data.checks.finger import check_finger
from jaxfinger.data.findings import Report
from jaxfinger.synthetic.paper_finger import box_inertia
from jaxfinger.synthetic.random_finger import random_finger
from tests.data.conftest import make_finger


def said(finger):
    report = Report()
    check_finger(finger, report)
    return [str(finding) for finding in report]


def finger(m=3) -> FingerDescription:
    """Planar finger of m rods, 45 to 25 mm long."""
    lengths = np.linspace(0.045, 0.025, m)
    mass, along = 0.4 * lengths, np.zeros((m, 3))
    along[:, 0] = lengths
    return replace(
        make_finger(),
        joint_names=tuple(f"J{i + 1}" for i in range(m)),
        axis=np.tile([0.0, 1.0, 0.0], (m, 1)),
        origin=np.vstack([np.zeros(3), along[:-1]]),
        limits=np.tile([0.0, 1.5], (m, 1)),
        mass=mass,
        com=0.48 * along,
        inertia=np.stack([box_inertia(*bar) for bar in zip(mass, lengths, strict=True)]),
        fingertip=along[-1],
        prismatic=(False,) * m,
        tendon_names=(),
        active=np.zeros(0, bool),
        crosses=np.zeros((0, m), bool),
        **dict.fromkeys(("mass_std", "rotor_inertia", "rotor_inertia_std", "excursion", "excursion_std")),
    )


def changed(key, change, row=None):
    """Change of one entry of the description, in one row or in all."""

    def of(finger):
        value = getattr(finger, key).copy()
        value[row if row is not None else ...] = change(value if row is None else value[row], finger)
        return replace(finger, **{key: value})

    return of


def joint(finger, i):
    """Place of joint i at q = 0."""
    return finger.origin[: i + 1].sum(axis=0)


def about_joint(I, f, i):
    return I + f.mass[i] * (f.com[i] @ f.com[i] * np.eye(3) - np.outer(f.com[i], f.com[i]))


MISTAKES = {
    "com from the far end": (changed("com", lambda c, f: c - f.origin[1], 0), "J1 hardly reaches joint J2", "far end"),
    "com from the fingertip": (changed("com", lambda c, f: c - f.fingertip, -1), "J3", "not from its far end"),
    "com from the base": (
        changed("com", lambda c, f: c + joint(f, 1), 1),
        "J2 hardly reaches its own",
        "from the base",
    ),
    "com along z": (
        changed("com", lambda c, f: c[[1, 2, 0]], 0),
        "J1 hardly reaches joint J2",
        "give `com` in the frame",
    ),
    "com in cm": (changed("com", lambda c, f: 100 * c, -1), "J3 has its centre of mass", "convert `com` to m"),
    "origin from the base": (
        changed("origin", lambda o, f: joint(f, 2), 2),
        "J2 hardly reaches joint J3",
        "count the next joint's `origin` from this joint",
    ),
    "origin ten times too far": (changed("origin", lambda o, f: 10 * o, 2), "J2 hardly", "the next joint's `origin`"),
    "origin zero": (changed("origin", lambda o, f: 0 * o, 2), "joints J2 and J3 turn about one", "the place of J3"),
    "fingertip from the base": (
        changed("fingertip", lambda p, f: p + joint(f, 2)),
        "the fingertip",
        "`fingertip` from",
    ),
    "inertia in g m2": (changed("inertia", lambda I, f: 1e3 * I, 0), "J1 has mass", "convert `inertia` to kg m2"),
    "inertia too small": (changed("inertia", lambda I, f: 1e-3 * I, 1), "J2 weighs", "even a ball of lead"),
    "mass in g": (changed("mass", lambda m, f: 1e3 * m, 2), "J3 weighs 10 kg", "check the units of `mass` (kg)"),
    "inertia about the joint": (changed("inertia", lambda I, f: about_joint(I, f, 0), 0), "note", "about the joint"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_named_with_its_mend(mistake):
    change, link, mend = MISTAKES[mistake]
    found = said(change(finger()))
    assert any(link in text and mend in text for text in found), found


@pytest.mark.parametrize("m", [1, 2, 3, 5, 7])
def test_fingers_of_rods_are_sound(m):
    assert said(finger(m)) == []


@pytest.mark.parametrize("layout", ["planar", "abduction", "spatial"])
def test_random_fingers_are_sound(layout):
    for m in range(1, 8):
        for seed in range(3):
            assert said(random_finger(seed, m, layout).description) == []


def body(*parts):
    """Mass, com (3,) and inertia (3, 3) of cubes, each given by mass, place and width."""
    mass = sum(m for m, _, _ in parts)
    com = sum(m * np.array(p) for m, p, _ in parts) / mass
    inertia = np.zeros((3, 3))
    for m, p, width in parts:
        r = np.array(p) - com
        inertia += m * ((width**2 / 6.0 + r @ r) * np.eye(3) - np.outer(r, r))
    return mass, com, inertia


@pytest.mark.parametrize(
    ("parts", "end"),
    [
        # A motor at the link's own joint, one at the next, one behind the own, and a link between crossing axes.
        ([(0.2, [0.0, 0.0, 0.0], 0.03), (0.012, [0.05, 0.0, 0.0], 0.02)], [0.1, 0.0, 0.0]),
        ([(0.02, [0.05, 0.0, 0.0], 0.02), (0.2, [0.1, 0.0, 0.005], 0.03)], [0.1, 0.0, 0.0]),
        ([(0.2, [-0.03, 0.0, 0.0], 0.03), (0.04, [0.05, 0.0, 0.0], 0.02)], [0.1, 0.0, 0.0]),
        ([(0.2, [0.0, 0.03, -0.05], 0.04)], [0.0, 0.0, 0.0]),
    ],
)
def test_motors_in_links_are_sound(parts, end):
    """Two links alike: the first reaches to a joint, the second to the fingertip."""
    mass, com, inertia = body(*parts)
    pair = replace(
        finger(2),
        axis=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        origin=np.array([[0.0, 0.0, 0.3], end]),
        mass=np.full(2, mass),
        com=np.stack([com, com]),
        inertia=np.stack([inertia, inertia]),
        fingertip=np.array([0.05, 0.0, 0.0]),
    )
    assert said(pair) == []


def test_a_weight_on_a_light_arm_is_sound():
    """A pendulum: nearly all of its mass is far from the joint."""
    mass, com, inertia = body((0.5, [0.5, 0.0, 0.0], 0.04), (0.005, [0.25, 0.0, 0.0], 0.01))
    one = finger(1)
    one = replace(one, mass=np.array([mass]), com=com[None], inertia=inertia[None], fingertip=np.array([0.5, 0.0, 0.0]))
    assert said(one) == []
