//! scratch
use magex_core::config::RunConfig;
use magex_core::ids::RunId;
use magex_learner::trainer::Trainer;
use magex::local::LocalCollector;
#[global_allocator]
static A: mimalloc::MiMalloc = mimalloc::MiMalloc;
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let config = RunConfig::from_toml(&std::fs::read_to_string(&args[1]).unwrap()).unwrap();
    let dir = std::path::PathBuf::from(&args[2]);
    let _ = std::fs::remove_dir_all(&dir);
    std::fs::create_dir_all(&dir).unwrap();
    let threads = args.get(3).map_or(2, |x| x.parse().unwrap());
    let (tx, rx) = std::sync::mpsc::channel();
    std::thread::spawn(move || for e in rx {
        match e {
            magex_learner::collector::RunEvent::Iteration(i) => {
                let v: serde_json::Value = serde_json::from_str(&i.metrics_json).unwrap();
                eprintln!("{} steps {} succ {} samp {} cov {} arr {} col {} cost {} scost {} | ratio {} ent {} | col {:.2} upd {:.2} cmd {:.2} wall {:.1}", v["iteration"], v["joint_env_steps"], v["success_rate"], v["sampled_success_rate"], v["all_covered_rate"], v["arrival_step"], v["collisions_per_agent_step"], v["cost_ratio"], v["sampled_cost_ratio"], v["executor"]["first_ratio_error"], v["executor"]["entropy"], v["timing"]["collect_s"].as_f64().unwrap(), v["timing"]["executor_s"].as_f64().unwrap(), v["timing"]["commander_s"].as_f64().unwrap(), v["wall_s"].as_f64().unwrap());
            }
            e => eprintln!("{e:?}"),
        }
    });
    let mut t = Trainer::create(&config, RunId("x".into()), &dir, threads).unwrap();
    let mut c = LocalCollector::new(&config, threads, tx, Default::default());
    let start = std::time::Instant::now();
    let o = t.run(&mut c).unwrap();
    println!("{o:?} {:?}", start.elapsed());
}
