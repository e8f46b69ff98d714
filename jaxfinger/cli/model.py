"""`jaxfinger identify`, `fit`, `validate`, `predict`, `show`: from sessions to models, from models to predictions."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from jaxfinger.cli.output import Output, print_json, progress, read, refuse_effects, refuse_output
from jaxfinger.errors import UserError, counted
from jaxfinger.fit_content import read_content

if TYPE_CHECKING:
    from jaxfinger.identify import Fit

Experiments = Annotated[list[str] | None, Parameter(name=["--experiments", "-e"], consume_multiple=True)]


def identify(
    file: Path,
    *,
    output: Output,
    recipe: str | None = None,
    joint: bool = False,
    ahead: bool = False,
    figures: Path | None = None,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Identify the complete dynamic model of a session: ID.2, ID.3-static, ID.3-dynamic, ID.4.

    A stage whose trials are missing is skipped and named; what the trials cannot determine is said by name.

    Parameters
    ----------
    file
        Session (HDF5).
    output
        Fit to write (JSON).
    recipe
        What to fit (TOML), or the name of a shipped one: paper, human-like, emps. By default the paper's.
    joint
        Refine all parameters on all trials at once afterwards.
    ahead
        Refine as with --joint, and on the motion of VD.3 too, by the angles that the model predicts a moment ahead.
    figures
        Folder for the paper's figures of this fit.
    json
        Print the parameters as JSON.
    overwrite
        Replace files that are already there.
    """
    refuse_output(output, overwrite, file, recipe)
    from jaxfinger.data.atomic import folder_to_fill
    from jaxfinger.identify import identify as run
    from jaxfinger.identify import read_recipe

    with folder_to_fill(figures) if figures is not None else nullcontext(), progress("identify") as say:
        wanted = read_recipe(recipe)
        say("reading the file")
        session = read(file)
        fit = run(session, wanted, progress=say)
        _refuse_empty(fit, file)
        if joint or ahead:
            fit = _refine(fit, session, say, ahead)
        content = _write(fit, session, output, overwrite)
        if figures is not None:
            _draw(fit, session, figures, overwrite, say)
    _report(content, json)


def _fit(
    stages: tuple[str, ...],
    file: Path,
    output: Path,
    start: Path | None,
    effects: Path | None,
    recipe: str | None,
    json: bool,
    overwrite: bool,
):
    """Run some stages of the identification on a session, write the fit and print it."""
    refuse_output(output, overwrite, file, start, effects, recipe)
    if start is not None and recipe is not None:
        raise UserError(f"{start}: a fit to start from brings its own recipe; leave out --recipe or --start")
    from jaxfinger.identify import identify as run
    from jaxfinger.identify import load_fit, read_recipe

    with progress("fit") as say:
        say("reading the file")
        session = read(file)
        first = load_fit(start, effects) if start else None
        fit = run(session, None if first else read_recipe(recipe), stages, first, say)
        _refuse_empty(fit, file)
        content = _write(fit, session, output, overwrite)
    _report(content, json)


def _refuse_empty(fit: Fit, file: Path) -> None:
    """Refuse a fit of which no stage had trials to read: its numbers would be the finger's description and zeros."""
    if all(s.status == "skipped" for s in fit.stages):
        raise UserError(f"{file}: {'; '.join(s.message for s in fit.stages)}; nothing is fitted, so nothing written")


def _stage_command(name: str, stages: tuple[str, ...], summary: str):
    """Make a command that runs these stages."""

    def command(
        file: Path,
        *,
        output: Output,
        start: Path | None = None,
        effects: Path | None = None,
        recipe: str | None = None,
        json: bool = False,
        overwrite: bool = False,
    ) -> None:
        _fit(stages, file, output, start, effects, recipe, json, overwrite)

    command.__name__ = name
    command.__doc__ = f"""{summary}

    Parameters
    ----------
    file
        Session (HDF5).
    output
        Fit to write (JSON).
    start
        A fit that holds the other parameters.
    effects
        The Python file of effects of your own, where that fit's model has some.
    recipe
        What to fit (TOML), without --start.
    json
        Print the parameters as JSON.
    overwrite
        Replace a file that is already there.
    """
    return command


fit_id2 = _stage_command("fit_id2", ("ID.2",), "Fit the moment arms alone (ID.2).")
fit_id3 = _stage_command(
    "fit_id3",
    ("ID.3-static", "ID.3-dynamic"),
    "Fit elastic torque, friction and damping of the joints alone (ID.3-static, ID.3-dynamic).",
)


def fit_id4(
    file: Path,
    *,
    output: Output,
    start: Path,
    effects: Path | None = None,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Fit the tendons' friction alone (ID.4), with the moment arms and joint torques of `start`.

    Parameters
    ----------
    file
        Session (HDF5).
    output
        Fit to write (JSON).
    start
        A fit of ID.2 and ID.3.
    effects
        The Python file of effects of your own, where that fit's model has some.
    json
        Print the parameters as JSON.
    overwrite
        Replace a file that is already there.
    """
    _fit(("ID.4",), file, output, start, effects, None, json, overwrite)


def fit_joint(
    file: Path, *, output: Output, start: Path, ahead: bool = False, json: bool = False, overwrite: bool = False
) -> None:
    """Refine every parameter on all trials at once.

    Parameters
    ----------
    file
        Session (HDF5).
    output
        Fit to write (JSON).
    start
        The fit to refine. One of other recordings is the prior, with its covariance.
    ahead
        Refine on the motion of VD.3 too, by the angles that the fit predicts a moment ahead.
    json
        Print the parameters as JSON.
    overwrite
        Replace a file that is already there.
    """
    refuse_output(output, overwrite, file, start)
    refuse_effects(start)
    from jaxfinger.identify import load_fit

    with progress("fit") as say:
        say("reading the file")
        session, first = read(file), load_fit(start)
        fit = _refine(first, session, say, ahead)
        content = _write(fit, session, output, overwrite)
    _report(content, json)


def fit_effects(
    file: Path,
    *,
    effect: Annotated[list[str], Parameter(consume_multiple=True)],
    output: Output,
    recipe: str | None = None,
    effects: Path | None = None,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Fit every nominal parameter on all trials at once, together with effects that are known to be there.

    Parameters
    ----------
    file
        Session (HDF5).
    effect
        An effect and where it sits: tendon_stretch:T3, or tendon_crosstalk:T3-T4 at a pair. Several may be named.
    output
        Fit to write (JSON).
    recipe
        The nominal model (TOML), or the name of a shipped recipe.
    effects
        A Python file with effects of your own, beside those of the catalogue.
    json
        Print the parameters as JSON.
    overwrite
        Replace a file that is already there.
    """
    refuse_output(output, overwrite, file, effects, recipe)
    keys = [_key(text) for text in effect]
    from jaxfinger.effects import load
    from jaxfinger.gap import fit_with
    from jaxfinger.identify import read_recipe

    with progress("fit") as say:
        wanted = read_recipe(recipe)
        own = load(effects) if effects is not None else {}
        say("reading the file")
        session = read(file)
        fit = fit_with(session, keys, wanted, own, say)
        content = _write(fit, session, output, overwrite)
    _report(content, json)


def _key(text: str) -> tuple[str, tuple[str, ...]]:
    """Name and site of an effect, from `name:site`."""
    name, _, site = text.partition(":")
    if not (name and site):
        raise UserError(f"--effect {text}: say the effect and where it sits, for example tendon_stretch:T3")
    return name, (site,)


def validate(
    fit: Path,
    file: Path,
    *,
    experiments: Experiments = None,
    effects: Path | None = None,
    figures: Path | None = None,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Say how well a fit predicts a session: error of every channel beside the noise floor.

    Parameters
    ----------
    fit
        Fit (JSON).
    file
        Session (HDF5), best of trials that the fit has not seen.
    experiments
        Which experiments; by default those of the fit's recipe, in the paper's VD.1, VD.2 and VD.3.
    effects
        The Python file of effects of your own, where the fit's model has some.
    figures
        Folder for the traces.
    json
        Print the scores as JSON.
    overwrite
        Replace figures that are already there.
    """
    from jaxfinger.cli.tables import print_validation
    from jaxfinger.data.atomic import folder_to_fill
    from jaxfinger.identify import load_fit
    from jaxfinger.identify.validate import validate as run

    with folder_to_fill(figures) if figures is not None else nullcontext(), progress("validate") as say:
        say("reading the files")
        loaded, session = load_fit(fit, effects), read(file)
        result = run(loaded, session, tuple(experiments) if experiments else None, say)
        if figures is not None:
            from jaxfinger.report.validation import draw_validation

            say("drawing")
            draw_validation(loaded, session, figures, overwrite)
    if json:
        print_json(result.as_dict())
    else:
        print_validation(result)


def predict(fit: Path, file: Path, *, output: Output, effects: Path | None = None, overwrite: bool = False) -> None:
    """Write what a fit predicts for every sample of a session, in the session's own layout.

    Parameters
    ----------
    fit
        Fit (JSON).
    file
        Session (HDF5).
    output
        Predictions to write (HDF5).
    effects
        The Python file of effects of your own, where the fit's model has some.
    overwrite
        Replace a file that is already there.
    """
    refuse_output(output, overwrite, fit, file, effects)
    from jaxfinger.data import write_predictions
    from jaxfinger.identify import load_fit
    from jaxfinger.identify.predictions import predict_session

    with progress("predict") as say:
        say("reading the files")
        loaded, session = load_fit(fit, effects), read(file)
        predictions = predict_session(loaded, session, progress=say)
        write_predictions(output, session, predictions, overwrite)
    print(f"{output}: {counted(len(predictions), 'trial')} predicted")


def show(fit: Path, *, effects: Path | None = None, json: bool = False) -> None:
    """Say what a fit file holds: stages, warnings, what the finger is like, every parameter with its 95 % interval.

    Parameters
    ----------
    fit
        Fit (JSON).
    effects
        The Python file of effects of your own, where the fit's model has some.
    json
        Print it as JSON.
    """
    content = read_content(fit)
    if "seen" not in content:  # A fit written by `save` lacks what people read.
        from jaxfinger.cli.tables import fit_to_read
        from jaxfinger.identify import load_fit

        content = fit_to_read(load_fit(fit, effects))
    try:
        _report(content, json)
    except KeyError as error:
        raise UserError(f"{fit}: is damaged, {error.args[0]!r} is missing; identify the session again") from None
    except (IndexError, TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{fit}: is damaged ({error}); identify the session again") from None


def _write(fit, session, output: Path, overwrite: bool) -> dict:
    """Write a fit made from `session`, and return the content of its file."""
    from jaxfinger.cli.tables import fit_to_read
    from jaxfinger.identify.fit_file import write_content

    content = fit_to_read(fit, session)
    write_content(content, output, overwrite)
    return content


def _refine(fit, session, say, ahead: bool):
    from jaxfinger.identify import refine

    say("refining on all trials at once")
    return refine(session, fit, say, ahead)


def _draw(fit, session, folder: Path, overwrite: bool, say) -> None:
    from jaxfinger.report.identification import draw_identification

    say("drawing")
    draw_identification(fit, session, folder, overwrite)


def _report(content: dict, json: bool) -> None:
    from jaxfinger.cli.tables import fit_as_dict, print_fit

    if json:
        print_json(fit_as_dict(content))
    else:
        print_fit(content)
