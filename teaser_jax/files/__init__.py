"""Matches and models from files, poses to files. Whatever is wrong with a file is said in one line."""

from teaser_jax.files.matches import MatchFile, read_matches
from teaser_jax.files.models import read_shape
from teaser_jax.files.poses import write_pose
from teaser_jax.ground.io import FileError

__all__ = ["FileError", "MatchFile", "read_matches", "read_shape", "write_pose"]
