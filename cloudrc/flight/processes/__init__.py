# SPDX-License-Identifier: Apache-2.0

"""The processes of a local run or of pods: world, cloud, one link per direction, and teleop."""
