"""Version of the program, and the git commit that it was made from."""

from __future__ import annotations

from pathlib import Path

__all__ = ["__version__", "commit", "version_text"]

__version__ = "0.1.0"  # as pyproject.toml states it; from the installation's metadata 0.02 s to read


def commit() -> str | None:
    """Git commit of a source checkout, or the one that a wheel or sdist was built from; None if not known.

    `-dirty` follows where files of the checkout differ from the commit.
    """
    import subprocess  # few commands ask

    here = Path(__file__).resolve().parent
    if (here.parent / ".git").exists():
        command = ["git", "-C", str(here), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=12"]
        try:
            return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError):
            return None
    try:
        return (here / "COMMIT").read_text(encoding="ascii").strip()
    except OSError:
        return None


def version_text() -> str:
    """One line: the version, and the commit where it is known."""
    made_from = commit()
    return f"boresight {__version__}" + (f" (commit {made_from})" if made_from else "")
