# SPDX-License-Identifier: Apache-2.0

"""The exercise of docs/exercise.md: three files that students fill in, and the checks of them."""
