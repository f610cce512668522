# SPDX-License-Identifier: Apache-2.0

"""Fly what the paper flew, and put its statements beside what is measured here."""
