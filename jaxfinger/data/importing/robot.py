"""The finger that some joints of a robot's description make: URDF or MJCF, read by MuJoCo.

The finger's frames are parallel at zero angles, as the format wants them: those of the file's world. Its base lies at
its first joint. Joints of the robot that are not the finger's are held where the file has them, and everything that
moves with a joint of the finger is one link.
"""
# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no types.)

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from jaxfinger.data.session import FingerDescription
from jaxfinger.data.units import beyond_a_turn
from jaxfinger.errors import UserError, did_you_mean, listed

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# kg and kg m²: MuJoCo gives at least these to links of which the file says less, such as frames and point masses.
_WITHOUT_MASS, _WITHOUT_INERTIA = 1e-9, 1e-12
_INERTIA = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
_ROUNDING = 1e-3  # of an inertia: files are written with few digits.
# Share of its neighbour that stands between two joints of one body, since every joint of a finger carries a link.
_BETWEEN_JOINTS = 1e-6
_DEGREE = 4  # of the polynomials of excursions, as of the recipes' moment arms (`moment_arm_degree`)
_ANGLES = 61  # through the range of a joint, to which a polynomial is fitted: 2° apart in 120°
_SAME_PLACE = 1e-9  # m: places that are nearer differ by rounding.
_MAX_DEVIATION = 0.02  # of a tendon's excursion: paths drawn by hand are hardly truer than that.
_DIGITS = 9  # that are written


class Terms(NamedTuple):
    """The linear springs, the damping and the friction of a robot's joints and tendons, as `[terms]` has them."""

    elastic: Float[np.ndarray, "m 2"]  # N m and N m/rad (N and N/m of a sliding joint): τ_k = a₀ + a₁ q
    friction: Float[np.ndarray, " m"]  # N m
    damping: Float[np.ndarray, " m"]  # N m s/rad
    tendon_friction: Float[np.ndarray, " n"]  # N: the part of the loss that does not grow with the tension


class RobotFinger(NamedTuple):
    """A finger from a robot's description, its terms, and sentences on what they cannot take over."""

    finger: FingerDescription
    terms: Terms
    remarks: tuple[str, ...]


def robot_finger(path: Path, joints: Sequence[str] = (), tip: str = "") -> RobotFinger:
    """Read a finger from a robot's description.

    Spatial tendons (MJCF) that cross its joints are its tendons. Those that an actuator pulls are active; all are
    where none pulls one. Excursions are polynomials of each joint alone, the others at zero.

    Args:
        path: URDF or MJCF.
        joints: names of the finger's joints, in any order; all of the robot's by default.
        tip: the site or link that is the fingertip; by default the farthest one of the last link.

    Raises:
        UserError: MuJoCo is not installed, or cannot read the file; a name is unknown; the joints do not lie on one
            way from base to tip, or are no hinges and slides; a link has no mass.
    """
    robot = _Robot(path, *_compiled(path))
    return RobotFinger(*robot.finger(robot.chain(joints), tip))


def _compiled(path: Path) -> tuple[Any, dict[str, float]]:
    """The file as a compiled model of MuJoCo, and by how much `_make_readable` changed the inertia of links."""
    try:
        import mujoco
    except ImportError:
        raise UserError(f"{path}: needs the package mujoco; install jaxfinger[robots]") from None
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give a URDF or an MJCF file") from None
    except ElementTree.ParseError as error:
        raise UserError(f"{path}: is no XML ({error}); give a URDF or an MJCF file") from None
    if root.tag not in ("robot", "mujoco"):
        raise UserError(f"{path}: begins with <{root.tag}>; give a URDF (<robot>) or an MJCF file (<mujoco>)")
    if any("xacro" in element.tag for element in root.iter()):
        raise UserError(f"{path}: still has macros; run `xacro {path.name} > robot.urdf`, and give that file")
    try:
        if root.tag == "mujoco":
            return _compiled_mjcf(path), {}
        changed = _make_readable(root)
        return mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode")), changed
    except ValueError as error:
        raise UserError(f"{path}: MuJoCo cannot read it: {' '.join(str(error).split())}") from None


def _compiled_mjcf(path: Path) -> Any:
    """Compiled MJCF file; without its meshes and pictures where these are not there, if no link has its mass from one.

    Raises:
        UserError: a link has its mass from a mesh that is not there.
    """
    import mujoco

    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        if "opening file" not in str(error):
            raise
    spec = mujoco.MjSpec.from_file(str(path))
    weighed = spec.compiler.inertiafromgeom != mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for geom in [geom for geom in spec.geoms if geom.meshname]:
        body = geom.parent
        if body.name != "world" and not (weighed and body.explicitinertial):
            raise UserError(
                f"{path}: link {body.name!r} has its mass from the mesh {geom.meshname!r}, which is not there; put the "
                "meshes where the file names them, or give the link an <inertial>"
            )
        spec.delete(geom)
    for item in (*spec.geoms, *spec.sites, *spec.tendons):
        item.material = ""
    for item in (*spec.meshes, *spec.skins, *spec.materials, *spec.textures):
        spec.delete(item)
    return spec.compile()


def _make_readable(robot: ElementTree.Element) -> dict[str, float]:
    """Change a URDF so that MuJoCo reads it.

    Meshes are left out, since they are not needed and often lie elsewhere. No body has a principal inertia that is
    negative, or larger than the sum of the other two: such a one is set to that bound.

    Returns:
        By link, the change of its inertia relative to its largest principal value, where that is more than rounding.
    """
    changed = {}
    for link in robot.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
        said = link.find("inertial/inertia")
        if said is None:
            continue
        given = np.array([[float(said.get(key, 0.0)) for key in row] for row in _INERTIA])
        size, axes = np.linalg.eigh(given)
        of_body = np.maximum(size, _WITHOUT_INERTIA)
        of_body[2] = min(of_body[2], (1.0 - 1e-9) * (of_body[0] + of_body[1]))  # MuJoCo compares to the last digit.
        if np.abs(of_body - size).max() > _ROUNDING * size[2] + _WITHOUT_INERTIA:
            changed[link.get("name", "")] = float(np.abs(of_body - size).max() / np.abs(size).max())
        for keys, values in zip(_INERTIA, axes * of_body @ axes.T, strict=True):
            for key, value in zip(keys, values, strict=True):
                said.set(key, repr(float(value)))
    least = {"boundmass": f"{_WITHOUT_MASS}", "boundinertia": f"{_WITHOUT_INERTIA}"}
    ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler", least, fusestatic="false")
    return changed


class _Robot:
    """A compiled robot, with the names of its joints and what hangs on what."""

    def __init__(self, path: Path, model: Any, changed: dict[str, float]):
        self.path, self.model, self.changed = path, model, changed
        self.names = [model.joint(j).name or f"joint_{j}" for j in range(model.njnt)]

    def chain(self, named: Sequence[str]) -> list[int]:
        """Joints of the finger from base to tip."""
        import mujoco

        for name in named:
            if name not in self.names:
                raise UserError(
                    f"{self.path}: has no joint {name}{did_you_mean(name, self.names)}; it has {listed(self.names, 40)}"
                )
        chosen = {self.names.index(name) for name in named} or set(range(len(self.names)))
        if not chosen:
            raise UserError(f"{self.path}: has no joint that moves; give the description of a robot with joints")
        ways = [self._way(j) for j in chosen]
        longest = max(ways, key=len)
        if not chosen <= set(longest):
            if named:
                raise UserError(
                    f"{self.path}: {', '.join(named)} do not lie on one way from base to tip; leave some out"
                )
            ends = [way for way in ways if not any(way[-1] in other[:-1] for other in ways)]
            said = " or ".join(",".join(self.names[j] for j in way) for way in ends)
            raise UserError(f"{self.path}: has several chains; name the joints of one with --joints: {said}")
        chain = [j for j in longest if j in chosen]
        kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        for j in chain:
            if not any(self.model.jnt_type[j] == kind for kind in kinds):
                raise UserError(f"{self.path}: the joint {self.names[j]} is no hinge and no slide; leave it out")
        return chain

    def _way(self, joint: int) -> list[int]:
        """Joints from the base to this one."""
        way, body = [joint], int(self.model.jnt_bodyid[joint])
        before = [j for j in self._joints(body) if j < joint]
        while body:
            way = before + way
            body = int(self.model.body_parentid[body])
            before = self._joints(body)
        return way

    def _joints(self, body: int) -> list[int]:
        first = int(self.model.body_jntadr[body])
        return [] if first < 0 else list(range(first, first + int(self.model.body_jntnum[body])))

    def finger(self, chain: Sequence[int], tip: str) -> tuple[FingerDescription, Terms, tuple[str, ...]]:
        """The finger that a chain of joints makes, its terms, and remarks."""
        import mujoco

        model = self.model
        at = model.jnt_qposadr[list(chain)]
        data = mujoco.MjData(model)
        data.qpos[at] = 0.0
        mujoco.mj_kinematics(model, data)
        anchors, axes = data.xanchor[list(chain)].copy(), data.xaxis[list(chain)].copy()
        link_of = self._link_of_bodies(chain)
        remarks = [*self._held(chain), *self._changed_links(link_of)]
        mass, com, inertia = self._links(chain, link_of, data, anchors)
        limits, said = self._limits(chain)
        fingertip, about_tip = self._fingertip(link_of, data, anchors[-1], com[-1], tip)
        rotors = model.dof_armature[model.jnt_dofadr[list(chain)]]
        tendons, excursion, about_tendons = self._tendons(data, at, limits)
        pulled = {int(k) for k in model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON, 0]}
        finger = FingerDescription(
            gravity=np.array(model.opt.gravity),
            joint_names=tuple(self.names[j] for j in chain),
            axis=_tidy(axes),
            origin=_tidy(np.diff(anchors, axis=0, prepend=anchors[:1])),
            limits=_tidy(limits),
            mass=_tidy(mass),
            com=_tidy(com),
            inertia=np.array([_tidy(I) for I in inertia]),
            fingertip=_tidy(fingertip),
            tendon_names=tuple(model.tendon(k).name or f"tendon_{k}" for k in tendons),
            active=np.array([k in pulled or not pulled & set(tendons) for k in tendons], bool),
            crosses=np.any(excursion != 0.0, axis=2),
            prismatic=tuple(bool(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE) for j in chain),
            rotor_inertia=_tidy(rotors) if rotors.any() else None,
            excursion=excursion if tendons else None,
        )
        terms, about_terms = self._terms(chain, tendons)
        return finger, terms, (*remarks, *said, *about_tip, *about_tendons, *about_terms)

    def _terms(self, chain: Sequence[int], tendons: Sequence[int]) -> tuple[Terms, tuple[str, ...]]:
        """Terms of the joints and tendons, and remarks on those that have no such form."""
        model, joints, k = self.model, np.array(chain), np.array(tendons, int)
        dof, spring = model.jnt_dofadr[joints], model.jnt_stiffness[joints]
        terms = Terms(
            _tidy(np.column_stack([-spring * model.qpos_spring[model.jnt_qposadr[joints]], spring])),
            _tidy(model.dof_frictionloss[dof]),
            _tidy(model.dof_damping[dof]),
            _tidy(model.tendon_frictionloss[k]),
        )
        bent = [self._has("jnt_stiffnesspoly", joints), self._has("dof_dampingpoly", dof)]
        along = [model.tendon_stiffness[k], model.tendon_damping[k]]
        remarks = [
            f"{self.names[j]}: of its spring and damping in the file only the linear parts are written"
            for j, has in zip(joints, np.any(bent, axis=0), strict=True)
            if has
        ]
        remarks += [
            f"{model.tendon(t).name}: a spring or damper along its path in the file is no part of a finger"
            for t, has in zip(k, np.any(along, axis=0), strict=True)
            if has
        ]
        return terms, tuple(remarks)

    def _has(self, table: str, rows: Int[np.ndarray, " r"]) -> Bool[np.ndarray, " r"]:
        """Whether each of the rows of a table of MuJoCo's has a number; none has where this MuJoCo lacks the table."""
        whole = getattr(self.model, table, None)
        return np.zeros(len(rows), bool) if whole is None else np.any(whole[rows], axis=1)

    def _held(self, chain: Sequence[int]) -> tuple[str, ...]:
        """Remarks on joints that the finger does not have, and on joints that follow others."""
        import mujoco

        remarks, names, model = [], self.names, self.model
        inside = [j for j in self._way(chain[-1]) if chain[0] < j and j not in chain]
        if inside:
            remarks.append(f"{listed([names[j] for j in inside])}: held where the file has it, since it is not named")
        for kind, first, second in zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True):
            if kind == mujoco.mjtEq.mjEQ_JOINT and second >= 0 and {first, second} & set(chain):
                here = "a joint of its own" if first in chain else "held"
                remarks.append(f"{names[first]}: follows {names[second]} in the file, and is {here} here")
        return tuple(remarks)

    def _changed_links(self, link_of: np.ndarray) -> list[str]:
        """Remarks on links of the finger whose inertia is not the file's."""
        of_finger = {self.model.body(b).name for b in np.flatnonzero(link_of >= 0)}
        return [
            f"{name}: its inertia in the file is impossible; one that is possible is written, {100 * share:.2g} % away"
            for name, share in self.changed.items()
            if name in of_finger
        ]

    def _link_of_bodies(self, chain: Sequence[int]) -> Int[np.ndarray, " b"]:
        """Number of the link to which each body belongs, −1 for the base."""
        link = np.full(self.model.nbody, -1)
        for body in range(1, self.model.nbody):  # Parents come first.
            own = [chain.index(j) for j in self._joints(body) if j in chain]
            link[body] = own[-1] if own else link[self.model.body_parentid[body]]
        return link

    def _links(self, chain: Sequence[int], link_of: np.ndarray, data: Any, anchors: np.ndarray):
        """Mass (m,), centre of mass from the joint (m, 3), and inertia about it (m, 3, 3) of every link."""
        model, m = self.model, len(chain)
        mass, com, inertia = np.zeros(m), np.zeros((m, 3)), np.zeros((m, 3, 3))
        for i in range(m):
            bodies = np.flatnonzero(link_of == i)
            if not len(bodies):
                continue
            own, at = model.body_mass[bodies], data.xipos[bodies] - anchors[i]
            mass[i] = own.sum()
            if mass[i] <= 2.0 * _WITHOUT_MASS * len(bodies):
                raise UserError(
                    f"{self.path}: what moves with {self.names[chain[i]]} has no mass; write its <inertial>"
                )
            com[i] = own @ at / mass[i]
            for b, mass_b, r in zip(bodies, own, at - com[i], strict=True):
                R = data.ximat[b].reshape(3, 3)
                inertia[i] += R @ np.diag(model.body_inertia[b]) @ R.T + mass_b * (r @ r * np.eye(3) - np.outer(r, r))
        for i in reversed(range(m)):
            if mass[i] == 0.0:  # Several joints of one body: nothing sits between them.
                mass[i], inertia[i] = _BETWEEN_JOINTS * mass[i + 1], _BETWEEN_JOINTS * inertia[i + 1]
        return mass, com, inertia

    def _limits(self, chain: Sequence[int]) -> tuple[Float[np.ndarray, "m 2"], tuple[str, ...]]:
        """Limits of the joints, and remarks on those that have none, or several turns."""
        import mujoco

        remarks, limits = [], np.array(self.model.jnt_range[list(chain)])
        for i, j in enumerate(chain):
            if not self.model.jnt_limited[j]:
                if self.model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE:
                    raise UserError(f"{self.path}: {self.names[j]} slides without limits; write its range")
                limits[i] = -np.pi, np.pi
                said = "half a turn to each side is written; give it more by `limits_deg` if it turns on"
                remarks.append(f"{self.names[j]}: has no limits in the file; {said}")
            elif self.model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and beyond_a_turn(limits[i]):
                turns = f"{np.ptp(limits[i]) / (2.0 * np.pi):.3g} turns"
                limits[i] = _in_whole_degrees(limits[i])
                said = f"the file's limits, read as rad, leave it {turns}"
                remarks.append(f"{self.names[j]}: {said}; if they are degrees, write them as `limits_deg`")
        return limits, tuple(remarks)

    def _fingertip(
        self, link_of: np.ndarray, data: Any, anchor: np.ndarray, com: np.ndarray, tip: str
    ) -> tuple[Float[np.ndarray, "3"], tuple[str, ...]]:
        """Fingertip from the last joint, and a remark where the file has none."""
        model, last = self.model, link_of.max()
        places = {model.body(b).name: data.xpos[b] for b in np.flatnonzero(link_of == last)}
        on_link = np.flatnonzero(link_of[model.site_bodyid] == last)
        places |= {model.site(s).name: data.site_xpos[s] for s in on_link}
        places.pop("", None)
        if tip:
            if tip not in places:
                near = did_you_mean(tip, places)
                raise UserError(f"{self.path}: the last link has no {tip}{near}; it has {listed(list(places), 40)}")
            return places[tip] - anchor, ()
        far = max(places, key=lambda name: np.linalg.norm(places[name] - anchor), default="")
        if not far or np.linalg.norm(places[far] - anchor) < _SAME_PLACE:
            said = "the file has no frame beyond the last joint; the centre of mass is written: correct it for VD.2"
            return com, (f"fingertip: {said}",)
        return places[far] - anchor, (f"fingertip: taken to be at {far}; name another one with --tip",)

    def _tendons(
        self, data: Any, at: np.ndarray, limits: Float[np.ndarray, "m 2"]
    ) -> tuple[list[int], Float[np.ndarray, "n m k"], tuple[str, ...]]:
        """Spatial tendons that cross the finger, the coefficients of their excursions, and remarks on their paths."""
        import mujoco

        model, m = self.model, len(at)
        spatial = [
            k for k in range(model.ntendon) if model.wrap_type[model.tendon_adr[k]] != mujoco.mjtWrap.mjWRAP_JOINT
        ]

        def pulled_in(angles: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N n"]:
            lengths = []
            for q in [np.zeros(m), *angles]:
                data.qpos[at] = q
                mujoco.mj_kinematics(model, data)
                mujoco.mj_comPos(model, data)
                mujoco.mj_tendon(model, data)
                lengths.append(data.ten_length[spatial].copy())
            return lengths[0] - np.array(lengths[1:])

        coefficients = np.zeros((len(spatial), m, _DEGREE))
        for i, (low, high) in enumerate(limits):
            q = np.linspace(low, high, _ANGLES)
            x = pulled_in(q[:, None] * np.eye(m)[i])
            crossed = np.ptp(x, axis=0) > _SAME_PLACE
            unit = np.abs(limits[i]).max() ** np.arange(1, _DEGREE + 1)
            fitted = np.linalg.lstsq(q[:, None] ** np.arange(1, _DEGREE + 1) / unit, x, rcond=None)[0].T / unit
            coefficients[crossed, i] = fitted[crossed]
        kept = [row for row in range(len(spatial)) if coefficients[row].any()]
        anywhere = np.random.default_rng(0).uniform(*limits.T, size=(_ANGLES * m, m))
        powers = anywhere[..., None] ** np.arange(1, _DEGREE + 1)
        measured, told = pulled_in(anywhere), np.einsum("sip,kip->sk", powers, coefficients)
        remarks = []
        for row in kept:
            miss, span = np.abs(measured - told)[:, row].max(), np.ptp(measured[:, row])
            if miss > _MAX_DEVIATION * span:
                remarks.append(
                    f"{model.tendon(spatial[row]).name}: its path in the file differs by up to {1e3 * miss:.2g} mm "
                    "from a sum of polynomials of single joints; set `cross_terms` in the recipe"
                )
        excursion = np.array([_tidy(coefficients[row]) for row in kept]).reshape(len(kept), m, _DEGREE)
        return [spatial[row] for row in kept], excursion, tuple(remarks)


def _in_whole_degrees(limits: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Limits of several turns, rad, moved outward to whole degrees, as the format has them.

    Whole numbers stay, and are refused: they are degrees in a file that should hold rad.
    """
    if np.all(limits == np.round(limits)):
        return limits
    lower, upper = np.degrees(limits)
    return np.radians([np.floor(lower), np.ceil(upper)])


def _tidy(x: np.ndarray) -> np.ndarray:
    """Numbers with nine digits; those that only rounding keeps from zero are zero."""
    least = 10.0**-_DIGITS * np.abs(x).max(initial=0.0)
    return np.vectorize(lambda v: 0.0 if abs(v) < least else float(f"{v:.{_DIGITS}g}"), otypes=[float])(x)
