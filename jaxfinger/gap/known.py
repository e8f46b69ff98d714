"""The model with effects that are known to be there: no verdict, only their sizes and shapes, fitted with the rest."""

from collections.abc import Sequence

from jaxfinger.data import Session
from jaxfinger.effects import CatalogueEffect
from jaxfinger.errors import UserError, did_you_mean
from jaxfinger.experiments import shows
from jaxfinger.gap.augment import augmented_fit
from jaxfinger.gap.evidence import Projector
from jaxfinger.gap.problem import Problem, build
from jaxfinger.gap.refine import Refined, at_optimum, refine, relinearised
from jaxfinger.gap.screening import Screening, by_site
from jaxfinger.gap.search import other_forms, start_of
from jaxfinger.gap.signatures import Variant, catalogue_for, variants
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.stages import Progress

Key = tuple[str, tuple[str, ...]]  # effect, site; a pair may be joined by a hyphen


def fit_with(
    session: Session,
    keys: Sequence[Key],
    recipe: Recipe | None = None,
    effects: dict[str, type[CatalogueEffect]] | None = None,
    progress: Progress = lambda message: None,
) -> Fit:
    """Nominal parameters and these effects at these sites, fitted to all trials together. `effects` adds a user's own.

    The effects join in order of what they explain, each in the form that suits the trials best.

    Raises:
        UserError: no effect of that name, not at that site, in the recipe's model already, or shown by no trial.
    """
    recipe, keys = recipe or Recipe(), list(dict.fromkeys(keys))
    if there := [effect for effect, _ in keys if effect in recipe.model.terms]:
        raise UserError(f"{there[0]} is a term of the recipe's own model; leave it out here, or there")
    catalogue = catalogue_for(recipe, effects)
    for effect, _ in keys:
        if effect not in catalogue:
            near = did_you_mean(effect, catalogue)
            raise UserError(f"the catalogue has no effect {effect}{near}; it has {', '.join(sorted(catalogue))}")
    problem = build(session, recipe, progress)
    screen = Screening.of(problem, _offered(catalogue, keys, problem), progress)
    projector = Projector(problem)
    rt = projector.residual(problem)
    chi2 = float(rt @ rt)
    chosen: Refined | None = None
    for _ in keys:
        if chosen is not None:
            projector = Projector(problem, chosen.columns)
            rt = projector.residual(problem, problem.r - chosen.change)
        screened = screen(projector, rt)
        taken = chosen.keys if chosen else ()
        first = next(e for e in by_site(screened).values() if e.variant.key not in taken)
        if not screen.signatures_of(first).any():
            effect, site = first.variant.effect, "-".join(first.variant.site)
            shown = ", ".join(shows(effect, problem.nominal.finger))
            file = session.file or "the session"
            raise UserError(f"{file}: no trial shows {effect.ID} at {site}; record {shown}, or leave it out")
        progress(f"fitting {first.variant.effect.ID} at {', '.join(first.variant.site)}")
        items, starts = at_optimum(chosen) if chosen else ([], [])
        forms = [first, *other_forms(screened, first)]
        found = [refine(problem, [*items, e.variant], [*starts, start_of(e)], chi2) for e in forms]
        led = [relinearised(problem, r, chi2) for r in found]
        problem, chosen = max(led, key=lambda x: x[1].log_evidence)
    assert chosen is not None
    progress("fitting the effects and all nominal parameters together")
    return augmented_fit(problem, chosen).fit


def _offered(catalogue: dict[str, type[CatalogueEffect]], keys: Sequence[Key], problem: Problem) -> list[Variant]:
    """Every form of the effects at their sites."""
    offered, finger = [], problem.nominal.finger
    for effect, site in keys:
        offers = variants({effect: catalogue[effect]}, finger, problem.scales)
        mine = [v for v in offers if "-".join(v.site) == "-".join(site)]
        if not mine:
            sites = ", ".join("-".join(s) for s in catalogue[effect].sites(finger)) or "no site on this finger"
            raise UserError(f"{effect} is not at {'-'.join(site)}; it has {sites}")
        offered += mine
    return offered
