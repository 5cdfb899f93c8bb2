"""How the commands of the documentation run in tests."""

from typing import Literal, NamedTuple

ENDED_BY_SIGINT = 130
Where = Literal["test", "trial", "long"]


class Way(NamedTuple):
    """How a documented command runs here. It ends by itself, or after its sign of life."""

    says: str  # regular expression: in what it prints
    where: Where = "test"
    more: str = ""  # options that make it short, or take another port
    instead: tuple[str, str] = ("", "")  # a piece of it, and what takes its place
    first: str = ""  # what makes its files, when no small file is in `documented_files`
    beside: str = ""  # the team that runs meanwhile
    until_sigint: bool = False
    codes: tuple[int, ...] = (0,)
    shows: tuple[str, ...] = ()  # beginnings of the outputs in the docs that have its tables


EXPERIMENT = "written: "
ONE_SEED = Way(EXPERIMENT, "long", "--seeds 1")
KNOWN = Way("RMSE m", instead=("6,20", "6,8"))
LIVE = Way("", "trial", until_sigint=True, codes=(ENDED_BY_SIGINT,))
ALIVE = r" ok\b"  # the state of a robot in the live table
