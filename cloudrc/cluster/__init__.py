"""Work with a release of the chart on Kubernetes: install it, fly missions, fetch recordings.

Entry points: `client.connect` selects a release, `release.install` installs a release,
`jobs.run_job` flies a mission, `jobs.follow` follows the mission, `pods.fetch_recording` copies a
recording.
"""
