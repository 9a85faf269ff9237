//! Headless Chromium, driven over WebDriver.

use fantoccini::{Client, ClientBuilder};
use hyper_util::client::legacy::connect::HttpConnector;
use magex_tests::sandbox::{PATIENCE, wait_until};
use serde_json::{Value, json};
use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A program that is killed when it is dropped.
pub(crate) struct Running(pub(crate) Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A request over a socket of our own; status line, headers and body.
pub(crate) fn request(address: &str, text: &str) -> String {
    let mut socket = TcpStream::connect(address).unwrap();
    socket.set_read_timeout(Some(PATIENCE)).unwrap();
    socket.write_all(text.as_bytes()).unwrap();
    // By its length: a server may leave a connection open although it was asked to close it.
    let mut reader = BufReader::new(socket);
    let (mut answer, mut length) = (String::new(), 0);
    while !answer.ends_with("\r\n\r\n") {
        let mut line = String::new();
        assert!(reader.read_line(&mut line).unwrap() > 0, "half an answer: {answer}");
        if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
            length = value.trim().parse().unwrap();
        }
        answer += &line;
    }
    let mut body = vec![0; length];
    reader.read_exact(&mut body).unwrap();
    answer + std::str::from_utf8(&body).unwrap()
}

/// Chromium and its driver.
pub(crate) struct Browser {
    pub(crate) client: Client,
    driver: String,
    _process: Running,
}

impl Browser {
    /// `None` on a machine without one.
    pub(crate) async fn start() -> Option<Self> {
        let found = Command::new("chromedriver").arg("--version").output().is_ok_and(|out| out.status.success());
        if !found {
            assert!(std::env::var_os("MAGEX_CI_BROWSER").is_none(), "chromedriver: not on this machine");
            // Straight to standard error: what is printed by a test that passes is not shown.
            let words = "*** NOT RUN: the live page was not looked at, for there is no chromedriver on this machine\n\
                         *** (Debian: apt-get install chromium chromium-driver)\n";
            std::io::stderr().write_all(words.as_bytes()).unwrap();
            return None;
        }
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let driver = format!("127.0.0.1:{port}");
        let process = Command::new("chromedriver")
            .arg(format!("--port={port}"))
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let process = Running(process);
        wait_until("the driver", || TcpStream::connect(&driver).is_ok());
        let arguments = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"];
        let capabilities = json!({
            "goog:chromeOptions": { "args": arguments },
            "goog:loggingPrefs": { "browser": "ALL" },
        });
        let Value::Object(capabilities) = capabilities else { unreachable!() };
        let client = ClientBuilder::new(HttpConnector::new())
            .capabilities(capabilities)
            .connect(&format!("http://{driver}"))
            .await
            .unwrap();
        client.set_window_size(1280, 800).await.unwrap();
        Some(Self { client, driver, _process: process })
    }

    pub(crate) async fn value(&self, expression: &str) -> Value {
        self.client.execute(&format!("return {expression}"), vec![]).await.unwrap()
    }

    pub(crate) async fn text(&self, id: &str) -> String {
        self.value(&format!("document.getElementById('{id}').innerText")).await.as_str().unwrap().to_owned()
    }

    /// Waits until an expression holds on the page.
    pub(crate) async fn until(&self, what: &str, expression: &str) {
        let start = Instant::now();
        while self.value(expression).await != json!(true) {
            if start.elapsed() > PATIENCE {
                let (state, banner) = (self.text("state").await, self.text("banner").await);
                panic!("waited too long for: {what}; the page says '{state}', '{banner}'; log: {:?}", self.log().await);
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// A call that WebDriver has no standard for; its value.
    pub(crate) async fn call(&self, path: &str, body: &Value) -> Value {
        let session = self.client.session_id().await.unwrap().unwrap();
        let body = body.to_string();
        let length = body.len();
        let answer = request(
            &self.driver,
            &format!(
                "POST /session/{session}/{path} HTTP/1.1\r\nHost: {}\r\nContent-Type: application/json\r\n\
                 Content-Length: {length}\r\nConnection: close\r\n\r\n{body}",
                self.driver
            ),
        );
        let value: Value = serde_json::from_str(answer.split_once("\r\n\r\n").unwrap().1).unwrap();
        value["value"].clone()
    }

    /// What the console said since the last call.
    pub(crate) async fn log(&self) -> Vec<String> {
        let value = self.call("se/log", &json!({ "type": "browser" })).await;
        value.as_array().unwrap().iter().map(|entry| entry["message"].to_string()).collect()
    }

    /// Makes the page as wide as a screen of this width. (A window is not narrower than 500 pixels.)
    pub(crate) async fn width(&self, width: u32) {
        let params = json!({ "width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500 });
        self.call("goog/cdp/execute", &json!({ "cmd": "Emulation.setDeviceMetricsOverride", "params": params })).await;
    }

    pub(crate) async fn points(&self) -> i64 {
        let text = self.value("document.getElementById('curve-success').dataset.points").await;
        text.as_str().unwrap().parse().unwrap()
    }

    pub(crate) async fn close(self) {
        self.client.close().await.unwrap();
    }
}
