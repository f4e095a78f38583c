"""What the pages of the papers say is there, also where only the top of the tests is run."""

from tests.docs.test_papers import *  # noqa: F403
