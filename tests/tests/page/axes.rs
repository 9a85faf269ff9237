//! What can be read on the page: axes, legends, the table of actors, and the numbers at a glance.

use crate::browser::Browser;
use magex_core::config::ExecutorKind;
use magex_proto::v1;
use magex_runtime::http;
use magex_tests::small;
use magex_viewer::page::{LivePage, RunEnd, RunInfo};
use serde_json::json;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;
use tokio_util::sync::CancellationToken;

/// A page with the curves of a run whose numbers have awkward labels, and an actor with the name of a container.
async fn awkward() -> (Arc<LivePage>, SocketAddr) {
    let mut config = small(ExecutorKind::Local, 5, 100);
    config.run.max_steps = 4_000;
    let info =
        RunInfo { learner: Some("127.0.0.1:7000".into()), lease: Some(Duration::from_secs(15)), ..RunInfo::default() };
    let page = Arc::new(LivePage::new(&config, info));
    for k in 0..=15_u32 {
        let small = 1.0 / f64::from(1 + k * k * k);
        let line = json!({
            "iteration": k, "joint_env_steps": 160 * k, "wall_s": 2 * k, "success_rate": 1.0 - small,
            "sampled_success_rate": 0.5, "arrival_step": 121.0 - f64::from(k), "collisions_per_agent_step": 0.1 * small,
            "sampled_collisions_per_agent_step": 0.01 + 0.1 * small, "cost_ratio": 1.0 + small, "sampled_cost_ratio": 1.1,
            "reward": -1234.5 * small,
            "executor": { "policy_loss": -0.0015 - 0.009 * small, "value_loss": 3.0 * small, "entropy": -0.0085 * small,
                "approx_kl": 1e-5, "actor_grad_norm": small, "critic_grad_norm": 30.0 * small },
        });
        page.line(&line.to_string());
    }
    let actor = v1::ActorStatus {
        actor_id: "3f2a9c1b7d4e-1".into(),
        address: "172.18.0.15:43210".into(),
        leases: 2,
        shards_done: 12_345,
        last_seen_ms: 9_500,
        threads: 4,
        weights_version: Some(3),
        ..Default::default()
    };
    let status = v1::RunStatus { state: v1::RunState::Collecting.into(), actors: vec![actor], ..Default::default() };
    let listening = http::bind("127.0.0.1:0").await.unwrap();
    let address = listening.address();
    listening.serve(page.routes(move || Some(status.clone())), CancellationToken::new());
    (page, address)
}

/// Pairs of labels of the horizontal axis that touch, and labels that are not whole.
const BAD_LABELS: &str = "[...document.querySelectorAll('figure[data-rows]')].filter(figure => !figure.hidden).flatMap(figure => {
    const width = figure.querySelector('canvas').clientWidth, height = figure.querySelector('canvas').clientHeight;
    const steps = JSON.parse(figure.dataset.steps ?? '[]'), rows = JSON.parse(figure.dataset.rows);
    return [
        ...steps.filter((one, k) => one.left < 0 || one.right > width || (k > 0 && one.left < steps[k - 1].right + 4)),
        ...rows.filter((one, k) => one.left < 0 || one.y < 4 || one.y > height || (k > 0 && one.y > rows[k - 1].y - 10)),
    ].map(one => `${figure.id}: ${one.words}`);
})";
/// Curves whose legend is not there, or not inside their card, and titles that are cut off.
const BAD_HEADS: &str = "[...document.querySelectorAll('figure')].filter(figure => !figure.hidden).flatMap(figure => {
    const card = figure.getBoundingClientRect(), inside = box => box.left >= card.left && box.right <= card.right + 0.5 && box.width > 0;
    const title = figure.querySelector('h2'), values = [...figure.querySelectorAll('.value')];
    const bad = [];
    if (title.scrollWidth > title.clientWidth + 1 || !inside(title.getBoundingClientRect())) bad.push(`${figure.id}: title`);
    if (values.length === 0 || values.some(one => !/[a-z]/.test(one.innerText) || !inside(one.getBoundingClientRect()))) bad.push(`${figure.id}: legend`);
    return bad;
})";

#[tokio::test(flavor = "multi_thread")]
async fn axes_and_legends_can_be_read_on_a_screen_and_on_a_phone() {
    let Some(browser) = Browser::start().await else { return };
    let (page, address) = awkward().await;
    for width in [1280, 390] {
        browser.width(width).await;
        browser.client.goto(&format!("http://{address}/")).await.unwrap();
        browser.until("the width", &format!("document.documentElement.clientWidth <= {width}")).await;
        browser.until("points", "document.getElementById('curve-success').dataset.points === '16'").await;
        browser.until("the actor", "document.getElementById('actors').tBodies[0].rows.length === 1").await;
        assert_eq!(browser.value("document.querySelectorAll('figure[data-rows]').length > 8").await, true);
        assert_eq!(browser.value(BAD_LABELS).await, json!([]), "{width}");
        assert_eq!(browser.value(BAD_HEADS).await, json!([]), "{width}");
        let labels = browser.value("JSON.parse(document.getElementById('curve-policy').dataset.rows)[0].words").await;
        assert!(labels.as_str().unwrap().starts_with('-'), "{labels}");
        let steps = browser.value("document.getElementById('curve-success').dataset.steps").await.to_string();
        assert_eq!(steps.matches("steps").count(), 1, "{steps}");
        let heads =
            browser.value("[...document.querySelectorAll('figcaption')].map(one => one.innerText).join('\\n')").await;
        for words in [
            "Value loss, log scale",
            "never counts as horizon + 1",
            "greedy evaluation",
            "sampled in training",
            "critic",
        ] {
            assert!(heads.as_str().unwrap().contains(words), "{words} at {width}: {heads}");
        }
        let table = "(() => { const table = document.getElementById('actors'), box = table.parentElement.getBoundingClientRect(); \
                     return table.rows[1].lastChild.getBoundingClientRect().right <= box.right + 0.5; })()";
        assert_eq!(browser.value(table).await, true, "the last column of the actors at {width}");
        assert_eq!(
            browser.value("document.documentElement.scrollWidth <= document.documentElement.clientWidth").await,
            true
        );
    }
    // What has been trained is what the last line has seen, and its own update.
    let (steps, iterations) = (browser.text("steps").await, browser.text("iteration").await);
    let per = browser.value("run.task.steps_per_iteration").await.as_u64().unwrap();
    assert_eq!((steps.replace(',', ""), iterations), ((2400 + per).to_string(), "16".to_owned()));
    assert_eq!(browser.text("success-more").await, "evaluation at 2.4 k steps");
    assert!(browser.text("steps-more").await.contains("to the budget"), "{}", browser.text("steps-more").await);
    assert_eq!(browser.value("document.querySelector('#actors tbody tr').className").await, "late");

    // The end: one hash, starts that are named, and no actor is late.
    let hash = "ff01449d9ec6a153".repeat(4);
    let summary = json!({ "success_rate": 0.684, "sampled_success_rate": 0.5, "final_episodes": 100, "iterations": 16,
        "weights_sha256": hash, "wall_s": 40.0, "collisions_per_agent_step": 0.01 });
    page.ended(RunEnd::Finished(summary));
    browser.until("the end", "document.getElementById('state').innerText === 'complete'").await;
    assert_eq!(browser.text("sha").await, "ff01449d9ec6…");
    assert_eq!(browser.text("sha-name").await, "weights.safetensors");
    assert!(browser.text("banner").await.contains("weights.safetensors ff01449d9ec6…"));
    assert_eq!(browser.text("success").await, "68.4 %");
    assert_eq!(browser.text("success-more").await, "closing evaluation, 100 new starts");
    assert!(browser.text("curve-success").await.contains("last in the curve"));
    let row = browser.value("document.querySelector('#actors tbody tr').innerText + document.querySelector('#actors tbody tr').className").await;
    assert!(row.as_str().unwrap().contains("has left") && !row.as_str().unwrap().contains("late"), "{row}");
    assert!(!browser.text("actors-sum").await.contains("silent"));
    assert_eq!(browser.log().await, [""; 0], "the console");
    browser.close().await;
}
