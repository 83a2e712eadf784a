//! The end of the viewer's server, and clients that do not keep to the protocol.

use crate::program::program;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Duration;

/// Exceeding it is a failure; it is not the time that the program needs.
const LIMIT: Duration = Duration::from_secs(120);

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A viewer of a small run, and its port.
fn viewer(directory: &Path) -> (Child, u16) {
    let (data, run) = (directory.join("data"), directory.join("run"));
    let ok = |args: &[&str]| {
        let out = program().args(args).output().unwrap();
        assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    };
    ok(&["phantom", text(&data), "--size", "32", "--phases", "4", "--views", "3", "--no-volumes"]);
    ok(&["train", text(&data), "-o", text(&run), "--stop-at", "20", "--no-eval"]);
    let mut server = program().args(["view", text(&run)]).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut url = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut url).unwrap();
    let port = url.trim().strip_prefix("http://127.0.0.1:").unwrap().split_once('/').unwrap().0.parse().unwrap();
    (server, port)
}

/// Sends the beginning of a request.
fn half_a_request(port: u16) -> TcpStream {
    let mut stream = TcpStream::connect(("127.0.0.1", port)).unwrap();
    stream.set_read_timeout(Some(LIMIT)).unwrap();
    stream.write_all(b"GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\n").unwrap();
    stream
}

#[test]
fn half_sent_requests_hold_up_neither_the_end_nor_other_clients() {
    let directory = tempfile::tempdir().unwrap();
    let (mut server, port) = viewer(directory.path());
    // More than there is room for: the connections that were accepted first are closed, which makes room for the others.
    let mut slow: Vec<TcpStream> = (0..80).map(|_| half_a_request(port)).collect();
    let mut rest = Vec::new();
    slow[0].read_to_end(&mut rest).expect("a client that sends no more is closed");
    let mut client = TcpStream::connect(("127.0.0.1", port)).unwrap();
    client.set_read_timeout(Some(LIMIT)).unwrap();
    client.write_all(b"GET /info HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    client.read_to_string(&mut answer).unwrap();
    assert!(answer.starts_with("HTTP/1.1 403"), "{answer}");
    let again = half_a_request(port);
    let interrupted = std::process::Command::new("kill").args(["-INT", &server.id().to_string()]).status().unwrap();
    assert!(interrupted.success());
    let ended = (0..LIMIT.as_millis() / 50).find_map(|_| {
        std::thread::sleep(Duration::from_millis(50));
        server.try_wait().unwrap()
    });
    if ended.is_none() {
        server.kill().unwrap();
    }
    assert!(ended.expect("the server ends although a request is not complete").success());
    drop((again, slow));
}
