# SPDX-License-Identifier: Apache-2.0

"""Run the command `cloudrc` as `python -m cloudrc`."""

from cloudrc.doors.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
