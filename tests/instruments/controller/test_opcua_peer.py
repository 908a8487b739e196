"""Another implementation of OPC UA, with the published model for CNC systems: node-opcua, from npm."""

import pytest
from coded import raises
from node_opcua import needs_node_opcua, node_opcua, write_certificate

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.opcua import OpcUa, OpcUaSettings

pytestmark = needs_node_opcua


@pytest.fixture(scope="module", autouse=True)
def server(tmp_path_factory):
    """The address of a server in a separate process."""
    with node_opcua(tmp_path_factory.mktemp("node-opcua")) as url:
        yield url


def test_the_published_model_is_read_with_its_units(server):
    with OpcUa(server, OpcUaSettings(timeout=20.0)) as cnc:
        identity, state = cnc.identify(), cnc.state()
    assert (identity.manufacturer, identity.model, identity.firmware) == ("node-opcua", "CNC of a test", "1.0")
    assert state["position"] == pytest.approx([0.10025, 0.10125, 0.10225])
    assert state["commanded_position"] == pytest.approx([0.100, 0.101, 0.102])
    assert (state["spindle_speed"], state["spindle_load"]) == pytest.approx((4500, 0.125))
    assert state["feed"] == pytest.approx(0.01)
    assert (state["mode"], state["program"], state["running"]) == ("mdi", "TEST.NC", True)
    assert state["unavailable"] == ["estop"]


@pytest.mark.slow
def test_two_sessions_one_after_the_other(server):
    found = []
    for _ in range(2):
        with OpcUa(server, OpcUaSettings(timeout=20.0)) as cnc:
            found.append(cnc.state()["position"])
    assert found[0] == found[1]


@pytest.mark.parametrize(
    ("policy", "uris", "suffix"),
    [
        ("Basic256Sha256", ["urn:mylab:client"], ".pem"),
        ("Basic256Sha256", ["urn:spindle.lab:em:1", "urn:another"], ".der"),
        ("Aes128Sha256RsaOaep", ["http://lab.example/errormotion"], ".pem"),
    ],
)
def test_an_encrypted_session_states_the_uri_of_the_certificate(server, tmp_path, policy, uris, suffix):
    security = f"{policy},SignAndEncrypt,{write_certificate(tmp_path, uris, suffix=suffix)}"
    with OpcUa(server, OpcUaSettings(timeout=20.0, security=security)) as cnc:
        assert cnc.state()["position"] == pytest.approx([0.10025, 0.10125, 0.10225])


def test_a_certificate_without_a_uri_is_refused_with_the_remedy(server, tmp_path):
    security = f"Basic256Sha256,SignAndEncrypt,{write_certificate(tmp_path, [])}"
    with pytest.raises(InstrumentError, match=r"BadCertificateUriInvalid.*must state a URI as subjectAltName"):
        OpcUa(server, OpcUaSettings(timeout=20.0, security=security)).open()


def test_a_mode_that_the_server_does_not_offer_is_named(server, tmp_path):
    security = f"Basic256Sha256,Sign,{write_certificate(tmp_path, ['urn:mylab:client'])}"
    with raises("opc.security.no_endpoint"):
        OpcUa(server, OpcUaSettings(timeout=20.0, security=security)).open()


@pytest.mark.parametrize(
    ("security", "message"),
    [
        ("Basic256Sha256,SignAndEncrypt,none.pem,none.pem", "expected a certificate .* in 'none.pem'"),
        ("Basic256Sha256,SignAndEncrypt,none.pem", "expected POLICY,MODE,CERTIFICATE,KEY"),
        ("Basic512,SignAndEncrypt,none.pem,none.pem", "found 'Basic512,"),
        ("Basic256Sha256,Encrypt,none.pem,none.pem", "found 'Basic256Sha256,Encrypt"),
    ],
)
def test_an_unusable_security_setting_is_named(server, security, message):
    with pytest.raises(InstrumentError, match=message):
        OpcUa(server, OpcUaSettings(timeout=20.0, security=security)).open()


def test_an_unusable_key_is_named(server, tmp_path):
    certificate = write_certificate(tmp_path, ["urn:mylab:client"]).split(",")[0]
    security = f"Basic256Sha256,SignAndEncrypt,{certificate},{certificate}"
    with raises("opc.security.key"):
        OpcUa(server, OpcUaSettings(timeout=20.0, security=security)).open()
