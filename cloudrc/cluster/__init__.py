"""Kubernetes: a release of the chart is found, installed, flown by Jobs, and read out.

The entry points: `access.connect` names a release, `jobs.run_job` flies a mission on it,
`follow.follow` tells how it goes, `deploy.install` puts it there, `fetch` brings back what it
recorded.
"""
