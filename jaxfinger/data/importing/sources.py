"""Loading of recordings of other tools by the kind of file: MATLAB .mat (v4 to v7.3), CSV, rosbag2 and MCAP."""

from __future__ import annotations

from pathlib import Path

from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.opening import plain_reason
from jaxfinger.errors import UserError


def load_recording(path: Path) -> Recording:
    """Load every numeric variable of a recording, and the reasons why others cannot be used.

    Raises:
        UserError: the file is missing, empty, of an unknown kind, or damaged.
    """
    refuse_path(path)
    kind = path.suffix.lower()
    try:
        if path.is_file() and path.stat().st_size == 0:
            raise UserError(f"{path}: is empty; export the recording again")
        if kind == ".mat":
            from jaxfinger.data.importing.matlab import load_mat

            return load_mat(path)
        if kind in (".csv", ".txt", ".tsv", ".dat", ".asc"):
            from jaxfinger.data.importing.csv_file import load_csv

            return load_csv(path)
        if path.is_dir() or kind in (".mcap", ".db3", ".bag"):
            from jaxfinger.data.importing.bags import load_bag

            return load_bag(path)
    except UserError:
        raise
    except PermissionError:
        raise UserError(f"{path}: may not be read; change its permissions") from None
    except Exception as error:  # Readers of foreign formats raise exceptions of many kinds.
        said = f"{type(error).__name__}: {plain_reason(error)}"
        raise UserError(f"{path}: cannot be read ({said}); export the recording again") from error
    raise UserError(f"{path}: is of an unknown kind; give .mat, .csv, .mcap or a rosbag2 folder")


def refuse_path(path: Path) -> None:
    """Refuse a path without a recording.

    Raises:
        UserError: the path does not exist, or is a folder without a rosbag2.
    """
    if not path.exists():
        raise UserError(f"{path}: does not exist; name a recording")
    if path.is_dir() and not any(any(path.glob(kind)) for kind in ("*.yaml", "*.db3", "*.mcap")):
        raise UserError(f"{path}: is a folder, and no rosbag2; name the recordings in it, as {path / '*.csv'}")
