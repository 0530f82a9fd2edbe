"""The server's process."""

from types import SimpleNamespace

from hilctl.desk.live import UntilEnded


def server(feed):
    return SimpleNamespace(feed=lambda name: feed)


def test_a_server_goes_on_until_its_pages_have_heard_of_the_end():
    now = [0.0]
    over = UntilEnded(lambda: now[0])
    assert not over(server(None))
    assert not over(server(SimpleNamespace(ended=False)))
    ended = server(SimpleNamespace(ended=True))
    assert not over(ended)
    now[0] = 1.4
    assert not over(ended)
    now[0] = 1.6
    assert over(ended)


def test_another_run_makes_it_go_on():
    now = [0.0]
    over = UntilEnded(lambda: now[0])
    over(server(SimpleNamespace(ended=True)))
    over(server(SimpleNamespace(ended=False)))
    now[0] = 5.0
    assert not over(server(SimpleNamespace(ended=True)))
