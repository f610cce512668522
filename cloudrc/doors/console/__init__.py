# SPDX-License-Identifier: Apache-2.0

"""The live page of a flight in the browser, and the 3-D scene that this page and reports show."""
