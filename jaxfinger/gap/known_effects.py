"""Fit of the model with effects that are known to be at work: their sizes and shapes, without a verdict."""

from collections.abc import Sequence

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import Session
from jaxfinger.effects import CatalogueEffect, OwnEffects, own_effects
from jaxfinger.errors import UserError, did_you_mean
from jaxfinger.experiments import affected_channels
from jaxfinger.gap.augment import augmented_fit
from jaxfinger.gap.costs import CauseKey
from jaxfinger.gap.exact import Baseline
from jaxfinger.gap.formula import Parameters
from jaxfinger.gap.problem import Problem, build
from jaxfinger.gap.screening import read_parts
from jaxfinger.gap.sets import Search
from jaxfinger.gap.signature_table import table_of
from jaxfinger.gap.signatures import Variant, catalogue_for, variants
from jaxfinger.identify import Fit, Recipe
from jaxfinger.model import Finger
from jaxfinger.progress import Progress


@one_blas_thread
def fit_with(
    session: Session,
    keys: Sequence[CauseKey],
    recipe: Recipe | None = None,
    effects: OwnEffects | None = None,
    progress: Progress = lambda message: None,
) -> Fit:
    """Fit the nominal parameters and given effects at given sites to all trials together.

    The effects are added in the order of what they explain, each in the shape that fits the trials best.

    Args:
        keys: effect and site of every cause; the names of a pair of joints or tendons may be joined by a hyphen.
        effects: a user's own effects, as of `diagnose`.

    Raises:
        UserError: an effect is unknown, cannot act at its site, is part of the recipe's model, or shows in no trial.
    """
    recipe, keys = recipe or Recipe(), list(dict.fromkeys(keys))
    if there := [effect for effect, _ in keys if effect in recipe.model.terms]:
        raise UserError(f"{there[0]} is a term of the recipe's own model; leave it out here, or there")
    finger = Finger.from_description(session.finger)
    catalogue = catalogue_for(recipe, own_effects(effects), finger)
    for effect, _ in keys:
        if effect not in catalogue:
            near = did_you_mean(effect, catalogue)
            raise UserError(f"the catalogue has no effect {effect}{near}; it has {', '.join(sorted(catalogue))}")
    _refuse_elsewhere(catalogue, keys, finger)
    problem = build(session, recipe, progress)
    offered = _offered(catalogue, keys, problem)
    baseline = Baseline.of(problem, Parameters())
    table = table_of(problem, baseline, read_parts(problem, offered, baseline.columns, progress), together=False)
    wanted = list(dict.fromkeys(v.key for v in offered))
    if unseen := [k for k in wanted if k not in table.keys]:
        (effect, site), file = unseen[0], session.file or "the session"
        shown = ", ".join(affected_channels(catalogue[effect], problem.nominal.finger))
        raise UserError(f"{file}: no trial shows {effect} at {'-'.join(site)}; record {shown}, or leave it out")
    search, state = Search(baseline, table, progress), baseline.start
    for _ in wanted:
        screened = search.screen(state)
        _, offer, amplitudes = search.best_offers(screened, 1)[0]
        found = search.fit_exactly(state, None, offer, amplitudes, screened.now.weights)
        state = search.with_best_choices(found, len(state.effects))
    progress("fitting the effects and all nominal parameters together")
    return augmented_fit(problem, state).fit


def _offered(catalogue: dict[str, type[CatalogueEffect]], keys: Sequence[CauseKey], problem: Problem) -> list[Variant]:
    """Variants of the effects at their sites."""
    offered, finger = [], problem.nominal.finger
    for effect, site in keys:
        offers = variants({effect: catalogue[effect]}, finger, problem.scales)
        offered += [v for v in offers if "-".join(v.site) == "-".join(site)]
    return offered


def _refuse_elsewhere(catalogue: dict[str, type[CatalogueEffect]], keys: Sequence[CauseKey], finger: Finger) -> None:
    """Raise a UserError for an effect that cannot act at its site."""
    for effect, site in keys:
        sites = ["-".join(s) for s in catalogue[effect].sites(finger)]
        if (named := "-".join(site)) not in sites:
            near = did_you_mean(named, sites)
            raise UserError(f"{effect} is not at {named}{near}; it has {', '.join(sites) or 'no site on this finger'}")
