"""The result of an identification."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.data import Session, data_hash, trial_hash
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.parameters import Free, describe, ravel, value_and_jacobian
from jaxfinger.identify.recipe import Recipe
from jaxfinger.model import Effect, Model
from jaxfinger.table import Table


@dataclass(frozen=True)
class StageReport:
    """Outcome of one stage."""

    name: str
    status: str  # `fitted`, `not converged` or `skipped`
    message: str = ""
    trials: tuple[str, ...] = ()
    rows: int = 0  # number of white residuals that are not zero
    chi2_per_row: float = float("nan")  # about 1 where model and noise are right
    outliers: float = 0.0  # share of white residuals beyond the robust limit
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, repr=False)
class Fit:
    """An identified model, the covariance of its flat vector (see `parameters`), and their provenance.

    >>> import jaxfinger as jf
    >>> fit = jf.load("fit.json")
    >>> fit
    Fit('EMPS', recipe 'emps': 4 parameters; ID.3-dynamic fitted)
    >>> fit.table().column("name")
    ['mass axis', 'elastic torque axis^0', 'damping axis', 'friction torque axis^0']
    """

    model: Model
    # Zero for parameters that are given. The diagonal is infinite for those that are undetermined, or that the
    # recipe has and no stage has estimated.
    covariance: Float[np.ndarray, "P P"]
    estimated: Int[np.ndarray, " p"]  # positions of the estimated parameters in the flat vector
    recipe: Recipe
    noise: dict[tuple[str, str], Noise] = field(default_factory=dict)  # by experiment and channel
    stages: tuple[StageReport, ...] = ()
    specimen: str = ""
    data: str = ""  # name of the file that it was made from; of several, with commas between them
    # Of that file's content, of each trial of a session in memory; of several, with spaces between them.
    data_hash: str = ""
    created: str = ""
    versions: dict[str, str] = field(default_factory=dict)

    @classmethod
    def before(cls, session: Session, recipe: Recipe, model: Model) -> "Fit":
        """Fit of a session before its first stage, with zero covariance."""
        P = ravel(model).size
        return cls(
            model,
            np.zeros((P, P)),
            np.zeros(0, int),
            recipe,
            specimen=session.specimen,
            data=Path(session.file).name,
            data_hash=_hash(session),
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            versions={p: version(p) for p in ("jaxfinger", "jax", "optimistix", "equinox", "numpy", "h5py")},
        )

    def was_made_from(self, session: Session) -> bool:
        """Whether the fit was made from the session's file, or from a trial of a session in memory."""
        return not {*_hash(session).split()}.isdisjoint(self.data_hash.split())

    def made_from(self, session: Session, alone: bool = False) -> "Fit":
        """Copy of the fit that names the session among those that it was made from, or `alone`."""
        name, digest = Path(session.file).name, _hash(session)
        if alone:
            return replace(self, data=name, data_hash=digest)
        new = [x for x in digest.split() if x not in self.data_hash.split()]
        if not new:
            return self
        data = ", ".join(filter(None, (self.data, name)))
        return replace(self, data=data, data_hash=" ".join(filter(None, (self.data_hash, *new))))

    @property
    def std(self) -> Float[np.ndarray, " P"]:
        """Standard deviation of every entry of the flat vector, in SI units."""
        return np.sqrt(np.maximum(np.diag(self.covariance), 0.0))

    def with_effect(self, effect: Effect, free: tuple[str, ...]) -> "Fit":
        """Copy of the fit with an effect added to its model; its parameters named in `free` count as estimated."""
        model = replace(self.model, effects=(*self.model.effects, effect))
        old, new = ravel(self.model).size, ravel(model).size
        added = [i for i in range(old, new) if describe(model)[i].term in free]
        covariance = np.zeros((new, new))
        covariance[:old, :old] = self.covariance
        return replace(self, model=model, covariance=covariance, estimated=np.append(self.estimated, added).astype(int))

    def __repr__(self) -> str:
        stages = ", ".join(f"{s.name} {s.status}" for s in self.stages) or "nothing estimated"
        return f"Fit({self.specimen!r}, recipe {self.recipe.name!r}: {len(self.estimated)} parameters; {stages})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.table()._repr_html_()}"

    def table(self) -> Table:
        """One row for each estimated parameter: name, group, value, std (None where undetermined) and SI units."""
        values, std, parameters = np.asarray(ravel(self.model)), self.std, describe(self.model)
        return Table(
            {
                "name": parameters[i].name,
                "group": parameters[i].group,
                "value": float(values[i]),
                "std": float(std[i]) if np.isfinite(std[i]) else None,
                "units": parameters[i].units,
            }
            for i in self.estimated
        )

    def function(
        self, f: Callable[[Model], Float[Array, "*k"]]
    ) -> tuple[Float[np.ndarray, "*k"], Float[np.ndarray, "*k"]]:
        """Value and standard deviation of a function `f` of the model that returns an array, by the delta method.

        The standard deviation is infinite where the value depends on an undetermined parameter. A program is compiled
        for each `f`; one of an `equinox.Module` that holds its arrays serves later processes, too.
        """
        seen = np.isfinite(np.diag(self.covariance))
        covariance = np.where(np.outer(seen, seen), self.covariance, 0.0)
        positions = np.flatnonzero((np.diag(covariance) > 0) | ~seen)
        uncertain = Free.at(self.model, positions)
        theta = jax.device_put(uncertain.get(self.model))
        value, J = map(np.asarray, value_and_jacobian(f, self.model, uncertain, theta))
        variance = np.einsum("...i,ij,...j->...", J, covariance[np.ix_(positions, positions)], J)
        unseen = np.any(J[..., ~seen[positions]] != 0.0, axis=-1)
        return value, np.where(unseen, np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _hash(session: Session) -> str:
    """Hash of the content of the session's file; of a session in memory, those of its trials with spaces between."""
    return data_hash(session.file) if session.file else " ".join(trial_hash(t) for t in session)
