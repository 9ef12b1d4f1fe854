"""What is installed only where it is asked for."""


def how_to_install(extra: str) -> str:
    """The command that brings an extra of pyproject.toml, for a line that says what is missing."""
    return f"pip install '.[{extra}]' in the folder of tactile-edge-sr"
