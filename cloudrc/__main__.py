"""`python -m cloudrc`: the same as the command `cloudrc`."""

from cloudrc.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())
