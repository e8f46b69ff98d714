"""`jaxfinger effects`: the catalogue of causes in words."""

from pathlib import Path


def effects(id: str | None = None, /, *, effects: Path | None = None) -> None:
    """List the effects that may make a finger differ from its model, or describe one of them in full.

    Parameters
    ----------
    id
        The effect's name, such as joint_presliding. All are listed without.
    effects
        A Python file with effects of your own, beside those of the catalogue.
    """
    from jaxfinger.effects import CATALOGUE, CHANGED, NOMINAL_TERMS, load
    from jaxfinger.errors import UserError, did_you_mean

    known = CATALOGUE | NOMINAL_TERMS | CHANGED | (load(effects) if effects is not None else {})
    if id is None:
        _list(known)
    elif id not in known:
        raise UserError(f"there is no effect {id}{did_you_mean(id, known)}; `jaxfinger effects` lists all")
    else:
        _describe(known[id])


def _list(known) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None)
    for column in ("effect", "at", "what happens"):
        table.add_column(column, no_wrap=column != "what happens")
    for name, kind in known.items():
        table.add_row(name, kind.PLACE.replace("_", " "), kind.HAPPENS)
    Console().print(table)


def _describe(kind) -> None:
    from rich.console import Console
    from rich.table import Table

    say = Console(highlight=False)
    say.print(f"[bold]{kind.ID}[/bold], at a {kind.PLACE.replace('_', ' ')}")
    for title, text in (
        ("What happens", kind.HAPPENS),
        ("In the data", kind.LOOKS),
        ("To change", kind.CHANGE),
        ("Formula", " ".join((kind.__doc__ or "").split())),
    ):
        say.print(f"\n[bold]{title}.[/bold] ", end="")
        say.print(text, markup=False)
    table = Table("parameter", "units", "plausible", box=None)
    for name, p in kind.amplitudes().items():
        table.add_row(name, p.units, f"{'±' if p.signed else ''}{p.size:g}{_times(p.of)}")
    for name, p in kind.shape_parameters().items():
        forms = [f"{v:g}: {said}" for v, said in zip(p.values, p.says, strict=False)]
        tried = ", ".join(f"{v:g}" for v in p.values)
        several = f"({tried})" if len(p.values) > 1 and p.of != "1" else tried
        table.add_row(name, p.units, "\n".join(forms) or several + _times(p.of))
    say.print()
    say.print(table)
    if any(p.of != "1" for p in kind.parameters().values()):
        say.print("\nScales, such as torque or length, are those of the finger and of its recordings.")


def _times(scale: str) -> str:
    """Text of the scale of the machine that a plausible size is a multiple of."""
    return "" if scale == "1" else f" × {scale.replace('*', ' · ')}"
