"""Access control: host names, token, origin."""

import pytest

from errormotion.dashboard.access import Access, access_for

NETWORK = access_for("0.0.0.0", ["Lab-PC.example"])


def test_only_loopback_without_control_requires_no_token() -> None:
    assert access_for("127.0.0.1", control=True).token
    assert not any(access_for(host).token for host in ("127.0.0.1", "::1", "localhost", "127.9.9.9"))
    tokens = [access_for(host).token for host in ("0.0.0.0", "::", "192.168.1.5", "lab-pc", "0.0.0.0")]
    assert len(set(tokens)) == len(tokens)
    assert min(map(len, tokens)) >= 32


@pytest.mark.parametrize("host", ["localhost:5006", "127.0.0.1", "[::1]:5006", "192.168.1.5:80", "LAB-pc.example:5006"])
def test_own_names_and_addresses_are_admitted(host: str) -> None:
    assert NETWORK.allows_host(host)


@pytest.mark.parametrize("host", ["", "evil.example", "localhost.evil.example", "evil@", "[", "1.2.3.4.evil:80"])
def test_a_page_under_a_foreign_name_is_refused(host: str) -> None:
    assert not NETWORK.allows_host(host)


def test_origin_is_that_of_the_page_itself() -> None:
    assert NETWORK.same_origin("http://lab-pc.example:5006", "Lab-PC.example:5006")
    secure = access_for("0.0.0.0", ["lab-pc.example"], secure=True)
    assert secure.same_origin("https://lab-pc.example:5006", "Lab-PC.example:5006")
    foreign = (
        None,
        "null",
        "http://evil.example",
        "http://lab-pc.example:5007",
        "http://[",
        "",
        "//lab-pc.example:5006",
    )
    schemes = ("https://lab-pc.example:5006", "ftp://lab-pc.example:5006", "wss://lab-pc.example:5006")
    for origin in (*foreign, *schemes):
        assert not NETWORK.same_origin(origin, "lab-pc.example:5006")
    for origin in ("http://lab-pc.example:5006", "ws://lab-pc.example:5006", *foreign):
        assert not secure.same_origin(origin, "lab-pc.example:5006")
    assert not NETWORK.same_origin("", "")


def test_token_opens_and_session_is_another_secret() -> None:
    assert NETWORK.accepts_token(NETWORK.token)
    assert not any(NETWORK.accepts_token(text) for text in ("", NETWORK.token[:-1], NETWORK.session, "é\ud800"))
    assert NETWORK.accepts_session(NETWORK.session)
    assert not any(NETWORK.accepts_session(text) for text in (None, "", NETWORK.token))
    assert not Access(frozenset()).accepts_token("")
    assert Access(frozenset()).accepts_session(None)


def test_the_token_for_control_is_that_of_one_host_and_no_cookie() -> None:
    token = NETWORK.control_for("lab-pc.example:5006")
    assert NETWORK.accepts_control(token, "LAB-pc.example:5006")
    for host in ("lab-pc.example:5007", "lab-pc.example", "192.168.1.5:5006", ""):
        assert not NETWORK.accepts_control(token, host)
    for other in (None, "", NETWORK.token, NETWORK.session, NETWORK.secret, token[:-1]):
        assert not NETWORK.accepts_control(other, "lab-pc.example:5006")
    assert not access_for("0.0.0.0").accepts_control(token, "lab-pc.example:5006")
