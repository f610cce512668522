"""Which folders an evaluation goes on with."""

from cloudrc.cli.main import main

LAW = "def infer(observation):\n    return {'actions': [[0]]}\n"
OTHER = [
    "--env Pendulum-v1 --policy {law}",
    "--env CartPole-v1 --env-arg sutton_barto_reward=true --policy {law}",
    "--env CartPole-v1 --policy {other}",
    "--env CartPole-v1 --policy ws://127.0.0.1:1",
]


def test_a_folder_takes_no_episodes_of_another_environment_or_policy(tmp_path, capsys):
    path, out = tmp_path / "law.py", tmp_path / "out"
    other = tmp_path / "other.py"
    for each in (path, other):
        each.write_text(LAW)
    first = f"eval --env CartPole-v1 --policy {path} --seeds 1 --jobs 1 --out {out}"
    assert main(first.split()) == 0
    before = {each.name: each.read_bytes() for each in out.iterdir()}
    capsys.readouterr()
    for line in OTHER:
        words = line.format(law=path, other=other).split()
        assert main(["eval", *words, "--seeds", "1", "--out", str(out)]) == 2
        said = f"--out {out}: has the episodes of CartPole-v1 with {path}, or of other arguments"
        assert said in capsys.readouterr().err
        assert {each.name: each.read_bytes() for each in out.iterdir()} == before
    assert main([*first.split(), "--rtt", "10", "--link", "lte", "--executor", "broker"]) == 0
    rows = (out / "rows.jsonl").read_text().splitlines()
    assert len(rows) == 3  # that without a network is the same
