# SPDX-License-Identifier: Apache-2.0
"""Where the packaged scenes and bags are, however the package came onto this machine."""

from pathlib import Path

PACKAGE = "sph_ros"


def share_folder() -> Path:
    """The folder with package.xml and scenes/ that belongs to this very code.

    A checkout (also through `pip install -e` or `colcon build --symlink-install`) holds them beside
    the code; pip and colcon put them into share/sph_ros of the prefix that holds the code.

    Raises:
        FileNotFoundError: the files were not installed with the code.
    """
    here = Path(__file__).resolve()
    checkout = here.parents[2]
    if (checkout / "package.xml").is_file() and (checkout / "scenes").is_dir():
        return checkout
    for prefix in here.parents[3:]:
        if (prefix / "share" / PACKAGE / "package.xml").is_file():
            return prefix / "share" / PACKAGE
    return _ament_share()


def _ament_share() -> Path:
    try:
        from ament_index_python.packages import PackageNotFoundError, get_package_share_directory
    except ImportError:
        raise FileNotFoundError(f"the files of {PACKAGE} are not beside its code") from None
    try:
        return Path(get_package_share_directory(PACKAGE))
    except (PackageNotFoundError, LookupError) as error:
        raise FileNotFoundError(f"the files of {PACKAGE} are not installed: {error}") from None
