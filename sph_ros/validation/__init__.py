# SPDX-License-Identifier: Apache-2.0
"""Physical tests with a known truth, for every solver: `sph_ros validate`.

One module per subject; each has checks, functions that take a `Case` and return rows of the table.
"""
