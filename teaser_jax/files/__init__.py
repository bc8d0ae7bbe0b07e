"""Files: clouds, matches and models in, poses in and out. Whatever is wrong with one is said in one line."""

from teaser_jax.files.cloud_file import CloudFile
from teaser_jax.files.clouds import read_cloud, write_cloud
from teaser_jax.files.matches import MatchFile, read_matches
from teaser_jax.files.models import read_shape
from teaser_jax.files.poses import PoseFile, read_poses, write_pose, write_poses
from teaser_jax.ground.io import FileError

__all__ = [
    "CloudFile", "FileError", "MatchFile", "PoseFile", "read_cloud", "read_matches", "read_poses",
    "read_shape", "write_cloud", "write_pose", "write_poses",
]  # fmt: skip
