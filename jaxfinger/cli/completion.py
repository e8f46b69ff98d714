"""`jaxfinger --install-completion` and `--show-completion`: the shell completes commands, options and files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from jaxfinger.errors import UserError

if TYPE_CHECKING:
    from cyclopts import App

Shell = Literal["bash", "zsh", "fish", "powershell"]


def show(app: App, shell: Shell | None) -> str:
    """Script that makes a shell complete `jaxfinger`.

    Raises:
        UserError: no shell is given, and the running one is not recognised.
    """
    return app.generate_completion(shell=_shell(shell))


def install(app: App, shell: Shell | None) -> str:
    """Install the script so that the shell reads it when it starts; returns a sentence that says where it is.

    Raises:
        UserError: no shell is given and the running one is not recognised, or the file cannot be written.
    """
    shell = _shell(shell)
    try:
        path = app.install_completion(shell=shell)
    except OSError as error:
        raise UserError(f"the script cannot be written ({error}); print it with --show-completion {shell}") from None
    return f"{path}: written; open a new terminal, and {shell} completes jaxfinger"


def _shell(given: Shell | None) -> Shell:
    """Name of the given shell, or of the running one."""
    from cyclopts.completion.detect import ShellDetectionError, detect_shell

    if given is not None:
        return given
    try:
        return detect_shell()
    except ShellDetectionError:
        raise UserError("which shell this is cannot be told; name it: bash, zsh, fish or powershell") from None
