# SPDX-License-Identifier: Apache-2.0
"""Compiled functions on plain arrays: neighbours, relaxation, distances, walls, surface."""
