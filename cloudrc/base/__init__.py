# SPDX-License-Identifier: Apache-2.0

"""What everything stands on: errors, texts, files, numbers, values and code of users, plug-ins."""
