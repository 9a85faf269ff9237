//! What a person sees of services that cannot come together, and of certificates that change: the built program, from outside.
#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use magex_core::config::ExecutorKind;
use magex_tests::sandbox::{Process, binary, wait_until};
use magex_tests::small;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A folder with certificates, and what is run in it.
struct Place(tempfile::TempDir);

impl Place {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).display().to_string()
    }

    /// Writes `name.pem` and `name.key`: a certificate that is trusted itself, good until the end of a year.
    fn sign(&self, name: &str, year: i32) {
        let mut params = rcgen::CertificateParams::new(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]).unwrap();
        params.not_after = rcgen::date_time_ymd(year, 12, 31);
        let key = rcgen::KeyPair::generate().unwrap();
        replace(&self.path(&format!("{name}.pem")), &params.self_signed(&key).unwrap().pem());
        replace(&self.path(&format!("{name}.key")), &key.serialize_pem());
    }

    fn process(&self, name: &str, line: &str) -> Process {
        let line = line.replace('@', &format!("{}/", self.0.path().display()));
        let variables = [("RUST_LOG".to_owned(), PathBuf::from("info"))];
        Process::start_in(&line.split(' ').collect::<Vec<_>>(), &variables, &self.path(name))
    }

    fn magex(&self, line: &str) -> Output {
        let line = line.replace('@', &format!("{}/", self.0.path().display()));
        Command::new(binary()).args(line.split(' ')).output().unwrap()
    }

    /// Fails with this code and these words, and is not ready before.
    fn fails(&self, line: &str, code: i32, words: &str) {
        let output = self.magex(line);
        let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        assert!(output.status.code() == Some(code) && err.contains(words), "{line}: {} {err}", output.status);
        assert!(!out.contains("ready"), "{line}: {out}");
    }
}

/// The metrics of a service.
fn scrape(address: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream
        .write_all(format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").as_bytes())
        .unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

fn replace(path: &Path, text: &str) {
    std::fs::write(path.with_extension("new"), text).unwrap();
    std::fs::rename(path.with_extension("new"), path).unwrap();
}

#[test]
fn what_cannot_be_used_is_named_before_anything_is_ready() {
    let place = Place::new();
    place.sign("one", 2100);
    place.sign("two", 2100);
    std::fs::write(place.path("file"), "").unwrap();
    let commander = "commander --listen 127.0.0.1:0";
    let mut owner = place.process("owner", &format!("{commander} --data @taken"));
    owner.ready();
    for (options, code, words) in [
        ("--data /proc/nope", 73, "--data /proc/nope"),
        ("--data @file", 73, "file: a file; give a folder"),
        ("--data @taken", 73, "another commander uses it"),
        ("--weights @nowhere", 64, "no such file; give the folder of a finished run"),
        ("--weights @file", 64, "file: not a weights file (safetensors); give the folder of a finished run"),
        ("--identities @file", 64, "--identities"),
        ("--identities @nowhere", 64, "--identities"),
        ("--tls-cert @one.pem --tls-key @two.key", 64, "--tls-key"),
        ("--tls-cert @one.key --tls-key @one.pem", 64, "are certificate and key exchanged?"),
        ("--learner 127.0.0.1:7000", 64, "use the form http://host:port"),
    ] {
        place.fails(&format!("{commander} {options}"), code, words);
    }
    place.fails("actor --learner 127.0.0.1:7555", 64, "use the form http://host:port");
    place.fails("actor --tls-ca @one.key", 64, "--tls-ca");
}

#[test]
fn an_actor_and_a_commander_are_ready_when_they_have_a_learner_and_say_so_until_then() {
    let place = Place::new();
    std::fs::write(place.path("run.toml"), small(ExecutorKind::Local, 5, 2).to_toml().unwrap()).unwrap();
    let mut commander = place.process("commander", "commander --listen 127.0.0.1:0");
    let other = format!("http://{}", commander.ready());
    let mut learner = place.process("learner", "learner --config @run.toml --out @run --listen 127.0.0.1:0");
    let url = format!("http://{}", learner.ready());

    // Each at the other's address: it says what is there, again and again, and is never ready.
    let mut lost = place.process("lost", &format!("actor --learner {other} --commander {other} --threads 1"));
    let mut astray = place.process("astray", &format!("commander --learner {other} --listen 127.0.0.1:0"));
    let words = "a commander answers at";
    wait_until("an actor to complain twice", || lost.log().matches(words).count() >= 2);
    wait_until("a commander to complain twice", || astray.log().matches(words).count() >= 2);
    for process in [&mut lost, &mut astray] {
        process.signal("TERM");
        process.wait();
        assert_eq!(process.output(), "", "{}", process.log());
    }
    let mut actor = place.process("actor", &format!("actor --learner {url} --commander {url} --threads 1"));
    assert_eq!(actor.ready_line()["service"], "actor");
    wait_until("an actor to miss its commander twice", || actor.log().matches("a learner answers at").count() >= 2);
    let mut follower = place.process("follower", &format!("commander --learner {url} --listen 127.0.0.1:0"));
    place.fails(&format!("assign --connect {url} --random 2"), 69, "a learner answers at");
    assert!(place.magex(&format!("health http://{}", follower.ready())).status.success());
}

#[test]
fn the_command_line_says_what_is_at_an_address() {
    let place = Place::new();
    ["one", "two"].iter().for_each(|name| place.sign(name, 2100));
    let tls = "--tls-cert @one.pem --tls-key @one.key";
    let mut secure = place.process("secure", &format!("commander --listen 127.0.0.1:0 {tls} --http 127.0.0.1:0"));
    let ready = secure.ready_line();
    let (address, page) = (ready["address"].as_str().unwrap(), ready["http"].as_str().unwrap());
    let mut mutual = place.process("mutual", &format!("commander --listen 127.0.0.1:0 {tls} --client-ca @one.pem"));
    let mutual = mutual.ready();
    let mut plain = place.process("plain", "commander --listen 127.0.0.1:0");
    let plain = plain.ready();
    let assign = |rest: &str| format!("assign --random 2 --scheduler exact --connect {rest}");
    for (rest, words) in [
        (format!("http://{address}"), "wants TLS; use https://"),
        (format!("http://{page}"), "a web server"),
        (format!("https://{plain} --tls-ca @one.pem"), "answers without TLS: use http://"),
        (format!("https://{address} --tls-ca @two.pem"), "is not of the CA in"),
        (format!("https://{mutual} --tls-ca @one.pem"), "wants a client certificate: give --tls-cert and --tls-key"),
        (format!("https://{mutual} --tls-ca @one.pem --tls-cert @two.pem --tls-key @two.key"), "client certificate"),
        ("http://127.0.0.1:1".to_owned(), "nothing listens at 127.0.0.1:1"),
        ("http://no.such.host.invalid:1".to_owned(), "cannot be resolved"),
    ] {
        place.fails(&assign(&rest), 69, words);
        if rest.starts_with("http://") {
            place.fails(&format!("health {rest}"), 69, words);
        }
    }
    for rest in [
        format!("http://{plain}"),
        format!("https://{address} --tls-ca @one.pem"),
        format!("https://{mutual} --tls-ca @one.pem {tls}"),
    ] {
        let output = place.magex(&assign(&rest));
        assert!(output.status.success(), "{rest}: {}", String::from_utf8_lossy(&output.stderr));
    }
    let output =
        place.magex(&format!("assign --scheduler exact --json --connect http://{plain} --agents [] --goals [[1,2]]"));
    assert!(output.status.success() && String::from_utf8_lossy(&output.stdout).contains("\"unassigned_goals\":[0]"));
}

#[test]
fn certificates_that_have_ended_or_end_soon_are_named_at_the_start_and_in_a_metric() {
    let place = Place::new();
    // A service's own certificate, and the one of the authority that it trusts.
    [("good", 2100), ("over", 2001)].iter().for_each(|(name, year)| place.sign(name, *year));
    for (name, tls, ended) in [
        ("fine", "--tls-cert @good.pem --tls-key @good.key --client-ca @good.pem", None),
        ("own", "--tls-cert @over.pem --tls-key @over.key", Some("over.pem")),
        ("trusted", "--tls-cert @good.pem --tls-key @good.key --client-ca @over.pem", Some("over.pem")),
    ] {
        let line = format!("commander --listen 127.0.0.1:0 --http 127.0.0.1:0 {tls}");
        let mut service = place.process(name, &line);
        let page = service.ready_line()["http"].as_str().unwrap().to_owned();
        let scraped = scrape(&page);
        let end = scraped.lines().find_map(|line| line.strip_prefix("process_certificate_end_time_seconds "));
        let end: f64 = end.unwrap_or_else(|| panic!("no end in {scraped}")).parse().unwrap();
        match ended {
            Some(file) => {
                let words = ["this certificate ended", "peers refuse it: renew it", file];
                wait_until("the warning", || words.iter().all(|word| service.log().contains(word)));
                assert!(end < 1.1e9, "{end}");
            }
            None => assert!(end > 4e9 && !service.log().contains("this certificate"), "{end} {}", service.log()),
        }
    }
}

#[test]
fn certificates_and_identities_are_read_again_and_bad_ones_change_nothing() {
    let place = Place::new();
    ["one", "two"].iter().for_each(|name| place.sign(name, 2100));
    let copy = |from: &str, to: &str| replace(&place.path(to), &std::fs::read_to_string(place.path(from)).unwrap());
    let hash = |token: &str| magex_proto::weights::sha256_hex(token.as_bytes());
    let identities =
        |token: &str| format!("[[identity]]\nname = 'a'\nrole = 'client'\ntoken_sha256 = '{}'\n", hash(token));
    copy("one.pem", "own.pem");
    copy("one.key", "own.key");
    replace(&place.path("identities"), &identities("first"));
    let tls = "--tls-cert @own.pem --tls-key @own.key --identities @identities";
    let mut commander = place.process("log", &format!("commander --listen 127.0.0.1:0 {tls}"));
    let address = commander.ready();
    let ask = |ca: &str, token: &str| {
        replace(&place.path("token"), token);
        let line = format!("assign --random 2 --connect https://{address} --tls-ca @{ca}.pem --token-file @token");
        place.magex(&line).status.success()
    };
    assert!(ask("one", "first") && !ask("two", "first") && !ask("one", "second"));

    // One file of a pair: the old pair stays, and the log says why.
    copy("two.pem", "own.pem");
    commander.signal("HUP");
    wait_until("a complaint", || commander.log().contains("does not belong to the first certificate in"));
    assert!(ask("one", "first"));
    copy("two.key", "own.key");
    commander.signal("HUP");
    wait_until("the new pair", || ask("two", "first"));
    assert!(!ask("one", "first"));

    // Identities, without a signal; and a file that cannot be used.
    replace(&place.path("identities"), "[[identity]]\nname = 'a'");
    wait_until("a complaint", || commander.log().contains("the identities cannot be read again"));
    assert!(ask("two", "first"));
    replace(&place.path("identities"), &identities("second"));
    wait_until("the new identities", || ask("two", "second"));
    assert!(!ask("two", "first") && commander.running());

    // A certificate that has ended is told of, and does not end the service.
    place.sign("own", 2001);
    wait_until("a warning", || commander.log().contains("this certificate ended"));
    assert!(commander.running());
}

#[test]
fn learner_and_actor_survive_a_hangup_and_read_again_what_they_show() {
    let place = Place::new();
    ["one", "two"].iter().for_each(|name| place.sign(name, 2100));
    std::fs::write(place.path("run.toml"), small(ExecutorKind::Local, 5, 2).to_toml().unwrap()).unwrap();
    std::fs::write(
        place.path("both.pem"),
        ["one.pem", "two.pem"].map(|name| std::fs::read_to_string(place.path(name)).unwrap()).concat(),
    )
    .unwrap();
    replace(&place.path("token"), "wrong\n");
    replace(
        &place.path("identities"),
        &format!(
            "[[identity]]\nname = 'a'\nrole = 'actor'\ntoken_sha256 = '{}'\n",
            magex_proto::weights::sha256_hex(b"right")
        ),
    );
    let tls = "--tls-cert @one.pem --tls-key @one.key --identities @identities";
    let mut learner =
        place.process("learner", &format!("learner --config @run.toml --out @run --listen 127.0.0.1:0 {tls}"));
    let address = learner.ready();
    // The commander has the learner's CA in the second version of its file only.
    std::fs::copy(place.path("two.pem"), place.path("ca.pem")).unwrap();
    replace(&place.path("goals"), "right");
    let mut commander = place.process(
        "commander",
        &format!("commander --listen 127.0.0.1:0 --learner https://{address} --tls-ca @ca.pem --token-file @goals"),
    );
    wait_until("a commander that does not trust", || commander.log().matches("is not of the CA in").count() >= 2);
    std::fs::copy(place.path("both.pem"), place.path("ca.pem")).unwrap();
    let commander_url = format!("http://{}", commander.ready());
    let mut actor = place.process(
        "actor",
        &format!("actor --learner https://{address} --commander {commander_url} --threads 1 --tls-ca @both.pem --token-file @goals"),
    );
    actor.ready_line();
    for process in [&mut learner, &mut actor, &mut commander] {
        process.signal("HUP");
        wait_until("files to be read again", || process.log().contains("again"));
        assert!(process.running());
    }
    let token = place.text("token");
    assert!(!learner.log().contains(&token) && !actor.log().contains("right"), "{}", actor.log());
}
