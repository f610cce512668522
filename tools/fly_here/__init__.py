# SPDX-License-Identifier: Apache-2.0

"""Make the page "fly it here": recorded flights that a browser draws, without a network."""
