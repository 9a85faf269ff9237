use super::*;

fn folder() -> std::path::PathBuf {
    std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/drones")
}

fn file(name: &str) -> String {
    std::fs::read_to_string(folder().join(name)).unwrap()
}

#[test]
fn the_recordings_are_reproduced() {
    let dir = std::env::var_os("MAGEX_DRONE_RECORDINGS").map_or_else(folder, Into::into);
    let mut names: Vec<_> = std::fs::read_dir(&dir).unwrap().map(|entry| entry.unwrap().path()).collect();
    names.sort();
    let mut failures = Vec::new();
    for path in &names {
        let report = verify_drones(&std::fs::read_to_string(path).unwrap()).unwrap();
        println!("{}: {}", path.file_name().unwrap().display(), report.content);
        for m in &report.measures {
            println!("    {:<40} {:.2e} (limit {:?}) {}", m.what, m.worst, m.limit, m.words);
        }
        failures.extend(report.disagreements().into_iter().map(|words| format!("{}: {words}", path.display())));
    }
    assert_eq!(failures, Vec::<String>::new());
    assert!(names.len() >= 3);
}
