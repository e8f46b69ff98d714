"""`jaxfinger --install-completion` and `--show-completion`: the shell completes commands, options and files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from jaxfinger.errors import UserError

if TYPE_CHECKING:
    from cyclopts import App

Shell = Literal["bash", "zsh", "fish", "powershell"]


def show(app: App, shell: Shell | None) -> str:
    """The script that makes a shell complete `jaxfinger`.

    Raises:
        UserError: no shell is given, and which one runs this cannot be told.
    """
    return app.generate_completion(shell=_shell(shell))


def install(app: App, shell: Shell | None) -> str:
    """Write that script where the shell looks for it, have it read at the start, and say where it is.

    Raises:
        UserError: the shell cannot be told, or the file cannot be written.
    """
    shell = _shell(shell)
    try:
        path = app.install_completion(shell=shell)
    except OSError as error:
        raise UserError(f"the script cannot be written ({error}); print it with --show-completion {shell}") from None
    return f"{path}: written; open a new terminal, and {shell} completes jaxfinger"


def _shell(given: Shell | None) -> Shell:
    from cyclopts.completion.detect import ShellDetectionError, detect_shell

    if given is not None:
        return given
    try:
        return detect_shell()
    except ShellDetectionError:
        raise UserError("which shell this is cannot be told; name it: bash, zsh, fish or powershell") from None
