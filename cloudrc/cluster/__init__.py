"""Work with a release of the chart on Kubernetes: install it, fly missions, fetch recordings.

Entry points: `client.connect` selects a release, `release.install` installs it, `jobs.run_job`
flies a mission, `jobs.follow` follows it, `pods.fetch_recording` copies a recording.
"""
