"""`jaxfinger diagnose`: where the model misses the finger, which effect is to blame, how far the gap shrinks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxfinger.cli.output import console, progress


def diagnose(
    session: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    recipe: str | None = None,
    predictions: Path | None = None,
    quick: bool = False,
    overwrite: bool = False,
) -> None:
    """Diagnose the gap between a session and the nominal model, or another simulator's predictions.

    Parameters
    ----------
    session
        Session (HDF5).
    output
        Folder for gap.json, nominal.json, augmented.json and the page.
    recipe
        The nominal model (TOML), or the name of a shipped recipe.
    predictions
        Another simulator's predictions for this session, in the layout that `predict` writes.
    quick
        A first look: fewer resamples.
    overwrite
        Replace an earlier diagnosis in the folder.
    """
    from jaxfinger.gap import diagnose as run

    with progress("diagnose") as say:
        result = run(
            session, output, recipe=recipe, predictions=predictions, quick=quick, overwrite=overwrite, progress=say
        )
    console().print(result.summary(), markup=False, soft_wrap=True)
