# SPDX-License-Identifier: Apache-2.0

"""Show recorded flights as a timeline: each command is a flow through the stages of its age."""
