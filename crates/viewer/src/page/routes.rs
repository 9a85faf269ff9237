//! The page over HTTP: `/`, and the JSON that its script asks for.

use super::{LivePage, points};
use crate::scene::SCRIPT;
use axum::Router;
use axum::body::Bytes;
use axum::extract::RawQuery;
use axum::http::header::{
    CACHE_CONTROL, CONTENT_SECURITY_POLICY, CONTENT_TYPE, ETAG, HeaderName, HeaderValue, IF_NONE_MATCH,
    REFERRER_POLICY, RETRY_AFTER, X_CONTENT_TYPE_OPTIONS,
};
use axum::http::{HeaderMap, StatusCode};
use axum::middleware::map_response;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use magex_proto::v1;
use magex_runtime::sync::lock;
use sha2::{Digest as _, Sha256};
use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

pub(super) const PAGE: &str = include_str!("page.html");

/// Shortest time between two answers to a viewer.
const GAP: Duration = Duration::from_millis(250);
/// Longest time until an answer, even without a new revision: the ages of the actors' last messages keep changing.
const HOLD: Duration = Duration::from_secs(1);

impl LivePage {
    /// The page and its data. `status` comes from the learner's service; `None` if everything runs in one process.
    pub fn routes(
        self: &Arc<Self>,
        status: impl Fn() -> Option<v1::RunStatus> + Clone + Send + Sync + 'static,
    ) -> Router {
        let html: Bytes = PAGE
            .replacen("@LIGHT@", &points::colours(false), 1)
            .replacen("@DARK@", &points::colours(true), 1)
            .replacen("@METRICS@", &points::plots(), 1)
            .replacen("@SCENE@", SCRIPT, 1)
            .into();
        let policy = policy(&html);
        let (run, rows, latest) = (self.clone(), self.clone(), self.clone());
        let page = move || {
            let (html, policy) = (html.clone(), policy.clone());
            async move { ([(CONTENT_TYPE, "text/html; charset=utf-8")], [(CONTENT_SECURITY_POLICY, policy)], html) }
        };
        let run = move |RawQuery(query): RawQuery| {
            let (page, status) = (run.clone(), status.clone());
            async move {
                let after = parameter(query.as_deref(), "after").and_then(|text| text.parse().ok());
                let state = async {
                    if let Some(after) = after {
                        page.news(after, GAP, HOLD).await;
                    }
                    json(page.state(status))
                };
                limited(&page, state).await
            }
        };
        let curve = move |RawQuery(query): RawQuery| {
            let page = rows.clone();
            async move {
                let after = parameter(query.as_deref(), "after").and_then(|text| text.parse().ok()).unwrap_or(0);
                let process = parameter(query.as_deref(), "process").unwrap_or_default();
                limited(&page, async { json(page.curve(process, after)) }).await
            }
        };
        let episode = move |headers: HeaderMap| {
            let page = latest.clone();
            async move { limited(&page, async { episode_of(&page, &headers) }).await }
        };
        Router::new()
            .route("/", get(page))
            .route("/api/run", get(run))
            .route("/api/curve", get(curve))
            .route("/api/episode", get(episode))
            .layer(map_response(guard))
    }
}

/// Content security policy: the page's own script and style (by SHA-256), and requests to its own origin.
fn policy(html: &[u8]) -> HeaderValue {
    let html = String::from_utf8_lossy(html);
    let hash = |tag: &str| {
        let (open, close) = (format!("<{tag}>"), format!("</{tag}>"));
        let inside = html.split_once(&open).and_then(|(_, rest)| rest.split_once(&close)).map_or("", |(text, _)| text);
        format!("'sha256-{}'", BASE64_STANDARD.encode(Sha256::digest(inside)))
    };
    let text = format!(
        "default-src 'none'; script-src {}; style-src {}; connect-src 'self'; img-src data:; base-uri 'none'; \
         form-action 'none'; frame-ancestors 'none'",
        hash("script"),
        hash("style")
    );
    HeaderValue::from_str(&text).unwrap_or(HeaderValue::from_static("default-src 'none'"))
}

/// Adds the headers that every response has.
async fn guard(mut response: Response) -> Response {
    let headers = response.headers_mut();
    for (name, value) in [
        (X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (REFERRER_POLICY, "no-referrer"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (CACHE_CONTROL, "no-cache"),
    ] {
        headers.insert(name, HeaderValue::from_static(value));
    }
    response
}

/// Answers, or rejects with 503 while [`VIEWERS`](super::VIEWERS) requests are in progress.
async fn limited(page: &LivePage, answer: impl Future<Output = Response>) -> Response {
    let Ok(_permit) = page.viewers.try_acquire() else {
        return (StatusCode::SERVICE_UNAVAILABLE, [(RETRY_AFTER, "5")], "too many viewers; try again\n")
            .into_response();
    };
    let answer = answer.await;
    *lock(&page.asked) = Some(Instant::now());
    answer
}

fn json(body: Bytes) -> Response {
    ([(CONTENT_TYPE, "application/json")], body).into_response()
}

/// The latest evaluation episode; 304 if the client has it already, 204 if there is none yet.
fn episode_of(page: &LivePage, headers: &HeaderMap) -> Response {
    let Some(episode) = lock(&page.episode).clone() else { return StatusCode::NO_CONTENT.into_response() };
    let tag = format!("\"{}\"", episode.tag);
    if headers.get(IF_NONE_MATCH).is_some_and(|known| known.as_bytes() == tag.as_bytes()) {
        return (StatusCode::NOT_MODIFIED, [(ETAG, tag)]).into_response();
    }
    ([(ETAG, tag)], json(episode.body)).into_response()
}

/// A parameter of a query whose values need no decoding.
fn parameter<'a>(query: Option<&'a str>, name: &str) -> Option<&'a str> {
    query?.split('&').find_map(|pair| pair.split_once('=').filter(|(key, _)| *key == name)).map(|(_, value)| value)
}
