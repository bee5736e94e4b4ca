#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The tracking tests without ROS on OpenCV 4.6, the version of Ubuntu 24.04 with the old functions of
# cv2.aruco, or on another one: tests/with_opencv_4_6.sh 4.10.0.84. Installs it into a temporary
# environment; the ordinary tests run on the newest OpenCV.
set -euo pipefail
cd "$(dirname "$0")/.."
unset LD_LIBRARY_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check \
  "opencv-contrib-python-headless==${1:-4.6.0.66}" 'numpy<2' numba scipy \
  scikit-image trimesh pyyaml rosbags imageio-ffmpeg matplotlib tqdm pytest
PYTHONPATH=$PWD "$folder/bin/python" -m pytest -q -p no:cacheprovider \
  tests/test_tracking_camera.py tests/test_tracking_filter.py tests/test_tracking_pictures.py
