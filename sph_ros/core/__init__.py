# SPDX-License-Identifier: Apache-2.0
"""Compiled functions on plain arrays: weights, neighbours, relaxation, distances, walls, surface."""
