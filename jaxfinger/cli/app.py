"""Table of the commands. Each is imported when it runs."""

from collections.abc import Callable
from functools import reduce

from cyclopts import App, CycloptsError, CycloptsPanel, MissingArgumentError, Parameter
from rich.text import Text

from jaxfinger.cli import completion


def _message(error: CycloptsError) -> object:
    """Message of an error: the help of the argument that is missing, or cyclopts' own message for other errors."""
    missing = error.argument
    if not isinstance(error, MissingArgumentError) or missing is None or error.keyword or not error.command_chain:
        return CycloptsPanel(error)
    name = missing.name if missing.index is None else missing.name.strip("-").upper()
    command = reduce(App.__getitem__, error.command_chain, app)
    known = command.assemble_argument_collection(parse_docstring=True)
    text = next(argument.parameter.help for argument in known if argument.name == missing.name)
    return Text(f"jaxfinger: {' '.join(error.command_chain)} needs {name}: {text}")


app = App(
    name="jaxfinger",
    error_formatter=_message,
    help="Identify the dynamic model of a tendon-driven finger, and say why the simulation still differs from it.",
    default_parameter=Parameter(negative=()),
)

COMMANDS = {
    "demo": ("demo:demo", "The whole story on a shipped session whose answer is known."),
    "new": ("new:new", "Write a finger and a mapping to fill in, for recordings of your own."),
    "check": ("files:check", "Say what is wrong with a session file."),
    "identify": ("model:identify", "The complete dynamic model of a session, with error bars."),
    "validate": ("model:validate", "How well a fit predicts the trials of a session."),
    "predict": ("model:predict", "What a fit predicts for every sample of a session."),
    "show": ("model:show", "What a fit file says."),
    "influence": ("influence:influence", "On which trials, sensors and CAD values each parameter of a fit depends."),
    "diagnose": (
        "diagnose:diagnose",
        "Where the model misses the finger, what is to blame, how far it shrinks.",
    ),
    "effects": ("effects:effects", "What may make a finger differ from its model: the catalogue of causes, in words."),
    "simulate": ("files:simulate", "A simulated session, of a described finger, a recipe or a fit."),
    "look": ("files:look", "Say what a recording holds, and propose a mapping for it."),
    "import": ("files:import_", "Turn recordings of other programs into a session."),
    "record": ("record:record", "Run a plan on the rig."),
    "recover": ("record:recover", "Rescue a recording that was killed."),
}
STAGES = {
    "id2": "Moment arms alone.",
    "id3": "Elastic torque, friction and damping of the joints alone.",
    "id4": "Tendon friction alone.",
    "joint": "All trials at once, from an earlier fit; one of other recordings is the prior.",
    "effects": "All trials at once, with effects beyond the nominal model that are known to be there.",
}
SEALED = {
    "make": "Make cases and hide their truth.",
    "run": "Diagnose every case.",
    "close": "Predict the fresh trials before and after each diagnosis.",
    "score": "Score the diagnoses against the truth.",
    "rivals": "Work out what is distinguishable in principle, for the ceiling of the score.",
}

for name, (place, text) in COMMANDS.items():
    app.command(f"jaxfinger.cli.{place}", name=name, help=text)

fit = App(name="fit", help="One stage of the identification at a time, or all trials at once.")
for name, text in STAGES.items():
    fit.command(f"jaxfinger.cli.model:fit_{name}", name=name, help=text)
app.command(fit)

sealed = App(name="sealed", help="The benchmark of the diagnosis, on cases whose truth is withheld.")
for name, text in SEALED.items():
    sealed.command(f"jaxfinger.cli.sealed:{name}", name=name, help=text)
app.command(sealed)


def _shell_command(act: Callable[[App, completion.Shell | None], str]) -> Callable[..., None]:
    """Make a command that prints the result of an action for a shell."""

    def command(shell: completion.Shell | None = None, /) -> None:
        """Let a shell complete commands, options and files.

        Parameters
        ----------
        shell
            The shell; by default the one that runs this.
        """
        print(act(app, shell))

    return command


for name, act, text in (
    ("--install-completion", completion.install, "Let your shell complete commands, options and files."),
    ("--show-completion", completion.show, "Print the script that does so, to install it yourself."),
):
    app.command(_shell_command(act), name=name, help=text)
