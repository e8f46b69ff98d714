"""The file of a fit: readable JSON with exact floats; infinities and NaN are null.

Parameters are named as in `describe`. Only rows of the covariance whose variance is not zero are stored.
"""

import json
import os
from dataclasses import asdict
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxfinger.data.atomic import atomic_path
from jaxfinger.effects import CatalogueEffect, from_dict, load, to_dict
from jaxfinger.errors import UserError, require
from jaxfinger.fit_content import SCHEMA, read_content
from jaxfinger.identify.fit import Fit, StageReport
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.parameters import describe, units_at
from jaxfinger.identify.recipe import as_dict, structure
from jaxfinger.jsonable import jsonable
from jaxfinger.model import Finger, JointTorque, Model, MomentArm, TendonFriction

FINGER: dict[str, tuple] = {
    "gravity": (3,),
    "axis": ("m", 3),
    "origin": ("m", 3),
    "mass": ("m",),
    "com": ("m", 3),
    "gyration": ("m", 3, 3),
    "rotor_inertia": ("m", "m"),
    "fingertip": (3,),
}
JOINT_TORQUE: dict[str, tuple] = {
    "elastic": ("m", -1),
    "damping": ("m",),
    "friction": ("m", -1),
    "friction_by_direction": ("m",),
    "damping_by_direction": ("m",),
    "torque_friction": ("m",),
}
TENDON_FRICTION: dict[str, tuple] = {"constant": ("n",), "proportional": ("n",)}
FINGER_STATIC = ("limits", "prismatic", "joint_names", "tendon_names", "active", "crosses")


def save_fit(fit: Fit, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a fit to `path`; where that fails, no partial file is left.

    >>> import jaxfinger as jf
    >>> jf.save(jf.load("fit.json"), "copy.json")

    Raises:
        UserError: the file exists and `overwrite` is false, or its folder cannot be written.
    """
    require(Fit, fit=fit)
    write_content(content_of(fit), path, overwrite)


def write_content(content: dict[str, Any], path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write the file of a fit from its content (`content_of`)."""
    lines = ",\n".join(f" {json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in content.items())
    with atomic_path(path, overwrite) as part:
        part.write_text("{\n" + lines + "\n}\n", encoding="utf-8")


def load_fit(path: str | os.PathLike, effects: str | os.PathLike | None = None) -> Fit:
    """Read a fit that `save_fit` wrote; `effects` is the Python file of a user's own effects in its model.

    >>> import jaxfinger as jf
    >>> jf.load("fit.json")
    Fit('EMPS', recipe 'emps': 4 parameters; ID.3-dynamic fitted)

    Raises:
        UserError: the file cannot be read, is no fit, has been damaged, or its model has an effect that neither the
            catalogue nor `effects` has.
    """
    content = read_content(path)
    try:
        return _from_dict(content, str(path), effects)
    except KeyError as e:
        raise UserError(f"{path}: is damaged, {e.args[0]!r} is missing; identify the session again") from None
    except (TypeError, ValueError, AttributeError, IndexError) as e:
        raise UserError(f"{path}: is damaged ({e}); identify the session again") from None


def content_of(fit: Fit) -> dict[str, Any]:
    """Content of the file of a fit."""
    model, names = fit.model, [p.name for p in describe(fit.model)]
    rows = np.flatnonzero(np.diag(fit.covariance) != 0)
    covariance = np.where(np.isfinite(fit.covariance), fit.covariance, np.inf)[np.ix_(rows, rows)]
    catalogued = [e for e in model.effects if isinstance(e, CatalogueEffect)]  # all of them: `describe` refuses others
    effects = [to_dict(e, units_at(model.finger, type(e), e.site)) for e in catalogued]
    content = {
        "schema": SCHEMA,
        "specimen": fit.specimen,
        "data": fit.data,
        "data_hash": fit.data_hash,
        "created": fit.created,
        "versions": fit.versions,
        "recipe": as_dict(fit.recipe),
        "stages": [asdict(s) for s in fit.stages],
        "finger": {k: np.asarray(getattr(model.finger, k)).tolist() for k in FINGER}
        | {k: getattr(model.finger, k) for k in FINGER_STATIC},
        "moment_arm": {
            "coefficients": np.asarray(model.moment_arm.coefficients).tolist(),
            "exponents": model.moment_arm.exponents,
        },
        "joint_torque": _arrays(model.joint_torque),
        "tendon_friction": _arrays(model.tendon_friction),
        "effects": effects,
        "estimated": [names[i] for i in fit.estimated],
        "covariance": {"names": [names[i] for i in rows], "matrix": covariance.tolist()},
        "noise": [
            {"experiment": e, "channel": c} | {k: v if isinstance(v, str) else v.tolist() for k, v in asdict(n).items()}
            for (e, c), n in fit.noise.items()
        ],
    }
    return jsonable(content)


def _arrays(module) -> dict[str, list]:
    return {k: np.asarray(v).tolist() for k, v in vars(module).items()}


def _from_dict(content: dict[str, Any], path: str, effects: str | os.PathLike | None) -> Fit:
    model = _model(content, path, effects)
    position = {p.name: i for i, p in enumerate(describe(model))}
    rows = np.array([position[name] for name in content["covariance"]["names"]], dtype=int)
    block = np.array(content["covariance"]["matrix"], dtype=float).reshape(rows.size, rows.size)
    covariance = np.zeros((len(position), len(position)))
    covariance[np.ix_(rows, rows)] = np.where(np.isnan(block), np.inf, block)
    return Fit(
        model,
        covariance,
        np.array([position[name] for name in content["estimated"]], dtype=int),
        structure(content["recipe"], path),
        noise={(n["experiment"], n["channel"]): _noise(n) for n in content["noise"]},
        stages=tuple(_stage(s) for s in content["stages"]),
        **{k: content[k] for k in ("specimen", "data", "data_hash", "created", "versions")},
    )


def _model(content: dict[str, Any], path: str, effects: str | os.PathLike | None) -> Model:
    f, arm = content["finger"], content["moment_arm"]
    m, n = len(f["joint_names"]), len(f["tendon_names"])
    size: dict[Any, Any] = {"m": m, "n": n}

    def arrays(group: str, shapes: dict[str, tuple]) -> dict[str, jnp.ndarray]:
        sizes = {k: tuple(size.get(s, s) for s in shape) for k, shape in shapes.items()}
        return {k: _array(content[group][k], shape, f"{group}.{k}") for k, shape in sizes.items()}

    finger = Finger(**arrays("finger", FINGER), **{k: _tuple(f[k]) for k in FINGER_STATIC})
    exponents = _tuple(arm["exponents"])
    model = Model(
        finger,
        MomentArm(_array(arm["coefficients"], (n, len(exponents)), "moment_arm.coefficients"), exponents),
        JointTorque(**arrays("joint_torque", JOINT_TORQUE)),
        TendonFriction(**arrays("tendon_friction", TENDON_FRICTION)),
    )
    if content["effects"]:
        own = load(effects) if effects is not None else {}
        try:
            known = tuple(from_dict(finger, e, own) for e in content["effects"])
        except UserError as e:
            raise UserError(f"{path}: {e}") from None
        model = Model(finger, model.moment_arm, model.joint_torque, model.tendon_friction, known)
    return model


def _array(values: list, shape: tuple[int, ...], name: str) -> jnp.ndarray:
    array = np.array(values, dtype=float)
    if 0 in shape and not array.size:
        array = array.reshape(shape)  # an empty list has no width, as for a finger without tendons
    if array.ndim != len(shape) or any(a != s for a, s in zip(array.shape, shape, strict=True) if s >= 0):
        raise ValueError(f"{name} has shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds a number that is not finite")
    return jnp.asarray(array)


def _tuple(value: Any) -> Any:
    return tuple(_tuple(v) for v in value) if isinstance(value, list) else value


def _noise(n: dict[str, Any]) -> Noise:
    return Noise(*(np.array(n[k], dtype=float) for k in ("std", "innovation", "ar")), source=n["source"])


def _stage(s: dict[str, Any]) -> StageReport:
    chi2 = float("nan") if s["chi2_per_row"] is None else s["chi2_per_row"]
    return StageReport(**{**s, "chi2_per_row": chi2, "trials": tuple(s["trials"]), "warnings": tuple(s["warnings"])})
