# SPDX-License-Identifier: Apache-2.0

"""Which folders an evaluation goes on with."""

LAW = "def infer(observation):\n    return {'actions': [[0]]}\n"
OTHER = [
    "--env Pendulum-v1 --policy {law}",
    "--env CartPole-v1 --env-arg sutton_barto_reward=true --policy {law}",
    "--env CartPole-v1 --policy {other}",
    "--env CartPole-v1 --policy ws://127.0.0.1:1",
]


def test_a_folder_takes_no_episodes_of_another_environment_or_policy(tmp_path, call):
    path, other, out = (tmp_path / name for name in ("law.py", "other.py", "out"))
    for each in (path, other):
        each.write_text(LAW)
    first = f"eval --env CartPole-v1 --policy {path} --seeds 1 --jobs 1 --out {out}"
    call(first)
    before = {each.name: each.read_bytes() for each in out.iterdir()}
    said = f"--out {out}: has the episodes of CartPole-v1 with {path}, or of other arguments"
    for line in OTHER:
        words = line.format(law=path, other=other)
        assert said in call(f"eval --seeds 1 --out {out} {words}", code=2).err
        assert {each.name: each.read_bytes() for each in out.iterdir()} == before
    call(f"{first} --rtt 10 --link lte --executor broker")
    rows = (out / "rows.jsonl").read_text().splitlines()
    assert len(rows) == 3  # that without a network is the same
