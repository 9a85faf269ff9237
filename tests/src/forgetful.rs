//! A disk that forgets: what a power cut leaves of a folder, of which only what was synced is certain.
//!
//! [`Recorder`] takes the steps of a program on the real file system and remembers them. [`Model`] takes the same steps on a tree in
//! memory that knows what is durable, and [`Model::after_power_cut`] draws one of the trees that a file system may come back with:
//! of the entries of a folder that was not synced any subset of the changes, of a file that was not synced the old content, any
//! later one, a part of one, or blocks of both.

use magex_core::rng::Stream;
use magex_learner::checkpoint::disk::{Disk, FileSystem};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// What a program did, with paths below the root.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// Made a folder.
    CreateDir(PathBuf),
    /// Made or replaced a file.
    Write(PathBuf, Vec<u8>),
    /// Added to a file.
    Append(PathBuf, Vec<u8>),
    /// Cut a file.
    Truncate(PathBuf, u64),
    /// Made a file or the entries of a folder durable.
    Sync(PathBuf),
    /// Gave another name in the same folder.
    Rename(PathBuf, PathBuf),
    /// Removed a file.
    RemoveFile(PathBuf),
    /// Removed a folder and what was in it.
    RemoveDir(PathBuf),
}

/// The real file system, and a record of the steps below a folder.
#[derive(Debug)]
pub struct Recorder {
    root: PathBuf,
    steps: Mutex<Vec<Step>>,
}

impl Recorder {
    /// Records what happens below `root`, and syncs of `root` itself.
    pub fn new(root: &Path) -> Self {
        Self { root: root.to_owned(), steps: Mutex::default() }
    }

    /// The steps so far.
    pub fn steps(&self) -> Vec<Step> {
        self.steps.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn done(&self, result: io::Result<()>, step: impl FnOnce(&dyn Fn(&Path) -> PathBuf) -> Step) -> io::Result<()> {
        result?;
        let below = |path: &Path| path.strip_prefix(&self.root).expect("a path below the root").to_owned();
        self.steps.lock().unwrap_or_else(PoisonError::into_inner).push(step(&below));
        Ok(())
    }
}

impl Disk for Recorder {
    fn create_dir(&self, path: &Path) -> io::Result<()> {
        self.done(FileSystem.create_dir(path), |below| Step::CreateDir(below(path)))
    }

    fn write(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.done(FileSystem.write(path, bytes), |below| Step::Write(below(path), bytes.to_vec()))
    }

    fn append(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        self.done(FileSystem.append(path, bytes), |below| Step::Append(below(path), bytes.to_vec()))
    }

    fn truncate(&self, path: &Path, length: u64) -> io::Result<()> {
        self.done(FileSystem.truncate(path, length), |below| Step::Truncate(below(path), length))
    }

    fn sync(&self, path: &Path) -> io::Result<()> {
        // A test does not wait for a real disk.
        std::fs::metadata(path)?;
        self.done(Ok(()), |below| Step::Sync(below(path)))
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        self.done(FileSystem.rename(from, to), |below| Step::Rename(below(from), below(to)))
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.done(FileSystem.remove_file(path), |below| Step::RemoveFile(below(path)))
    }

    fn remove_dir(&self, path: &Path) -> io::Result<()> {
        self.done(FileSystem.remove_dir(path), |below| Step::RemoveDir(below(path)))
    }
}

type Node = usize;
type Entries = BTreeMap<String, Node>;

/// A change of a folder's entries that is not durable yet.
#[derive(Debug, Clone)]
enum Change {
    Link(String, Node),
    Unlink(String),
    Rename(String, String, Node),
}

impl Change {
    fn apply(&self, entries: &mut Entries) {
        match self {
            Self::Link(name, node) => drop(entries.insert(name.clone(), *node)),
            Self::Unlink(name) => drop(entries.remove(name)),
            Self::Rename(from, to, node) => {
                entries.remove(from);
                entries.insert(to.clone(), *node);
            }
        }
    }
}

#[derive(Debug, Clone)]
enum Content {
    Folder {
        durable: Entries,
        pending: Vec<Change>,
    },
    /// The durable content, and those that it had since.
    File {
        durable: Vec<u8>,
        since: Vec<Vec<u8>>,
    },
}

/// A tree that knows what is durable.
#[derive(Debug, Clone)]
pub struct Model {
    nodes: Vec<Content>,
}

/// What is on the disk of a power cut is read and written in blocks of this size.
const BLOCK: usize = 512;

impl Default for Model {
    fn default() -> Self {
        Self { nodes: vec![Content::Folder { durable: Entries::new(), pending: Vec::new() }] }
    }
}

impl Model {
    /// A tree that is on disk, all of it durable.
    pub fn of(folder: &Path) -> Self {
        let mut model = Self::default();
        model.load(0, folder);
        model
    }

    fn load(&mut self, node: Node, folder: &Path) {
        for entry in std::fs::read_dir(folder).expect("a folder").map(|entry| entry.expect("an entry")) {
            let (name, path) = (entry.file_name().into_string().expect("a name"), entry.path());
            let new = self.nodes.len();
            if path.is_dir() {
                self.nodes.push(Content::Folder { durable: Entries::new(), pending: Vec::new() });
                self.load(new, &path);
            } else {
                let durable = std::fs::read(&path).expect("a file");
                self.nodes.push(Content::File { durable, since: Vec::new() });
            }
            if let Content::Folder { durable, .. } = &mut self.nodes[node] {
                durable.insert(name, new);
            }
        }
    }

    /// Takes a step.
    pub fn step(&mut self, step: &Step) {
        match step {
            Step::CreateDir(path) if self.find(path).is_none() => {
                self.link(path, Content::Folder { durable: Entries::new(), pending: Vec::new() });
            }
            Step::CreateDir(_) => {}
            Step::Write(path, bytes) => {
                let node = match self.find(path) {
                    Some(node) => node,
                    None => self.link(path, Content::File { durable: Vec::new(), since: Vec::new() }),
                };
                self.edit(node, |content| content.clear());
                self.edit(node, |content| content.clone_from(bytes));
            }
            Step::Append(path, bytes) => self.edit(self.at(path), |content| content.extend_from_slice(bytes)),
            Step::Truncate(path, length) => self.edit(self.at(path), |content| content.truncate(*length as usize)),
            Step::Sync(path) => {
                let node = self.at(path);
                match &mut self.nodes[node] {
                    Content::Folder { durable, pending } => {
                        pending.drain(..).for_each(|change| change.apply(durable));
                    }
                    Content::File { durable, since } => {
                        if let Some(last) = since.pop() {
                            *durable = last;
                        }
                        since.clear();
                    }
                }
            }
            Step::Rename(from, to) => {
                let change = Change::Rename(name(from), name(to), self.at(from));
                self.change(from, change);
            }
            Step::RemoveFile(path) => self.change(path, Change::Unlink(name(path))),
            Step::RemoveDir(path) => {
                let node = self.at(path);
                for child in self.entries(node).into_keys() {
                    let child = path.join(child);
                    let folder = matches!(self.nodes[self.at(&child)], Content::Folder { .. });
                    self.step(&if folder { Step::RemoveDir(child) } else { Step::RemoveFile(child) });
                }
                self.change(path, Change::Unlink(name(path)));
            }
        }
    }

    /// Writes what a power cut at this moment may leave into an empty folder.
    pub fn after_power_cut(&self, stream: &mut Stream, to: &Path) {
        // Some file systems keep the order of changes, some lose the last seconds as a whole, some neither.
        let style = Style::draw(stream);
        self.write(0, style, stream, to);
    }

    fn write(&self, node: Node, style: Style, stream: &mut Stream, to: &Path) {
        match &self.nodes[node] {
            Content::File { durable, since } => {
                std::fs::write(to, style.content(durable, since, stream)).expect("a file can be written");
            }
            Content::Folder { durable, pending } => {
                std::fs::create_dir_all(to).expect("a folder can be made");
                let mut entries = durable.clone();
                style.changes(pending, stream).for_each(|change| change.apply(&mut entries));
                for (name, node) in entries {
                    self.write(node, style, stream, &to.join(name));
                }
            }
        }
    }

    fn entries(&self, node: Node) -> Entries {
        match &self.nodes[node] {
            Content::Folder { durable, pending } => {
                let mut entries = durable.clone();
                pending.iter().for_each(|change| change.apply(&mut entries));
                entries
            }
            Content::File { .. } => Entries::new(),
        }
    }

    fn find(&self, path: &Path) -> Option<Node> {
        path.iter().try_fold(0, |node, name| self.entries(node).get(name.to_str()?).copied())
    }

    fn at(&self, path: &Path) -> Node {
        self.find(path).unwrap_or_else(|| panic!("{} is not there", path.display()))
    }

    fn link(&mut self, path: &Path, content: Content) -> Node {
        let node = self.nodes.len();
        self.nodes.push(content);
        self.change(path, Change::Link(name(path), node));
        node
    }

    /// A change of an entry of the folder that `path` is in.
    fn change(&mut self, path: &Path, change: Change) {
        let parent = self.at(path.parent().unwrap_or(Path::new("")));
        if let Content::Folder { pending, .. } = &mut self.nodes[parent] {
            pending.push(change);
        }
    }

    fn edit(&mut self, node: Node, edit: impl FnOnce(&mut Vec<u8>)) {
        if let Content::File { durable, since } = &mut self.nodes[node] {
            let mut content = since.last().unwrap_or(durable).clone();
            edit(&mut content);
            since.push(content);
        }
    }
}

fn name(path: &Path) -> String {
    path.file_name().and_then(|name| name.to_str()).expect("a name").to_owned()
}

/// What survives of changes that were not synced.
#[derive(Debug, Clone, Copy)]
enum Style {
    /// All: the cut came late.
    All,
    /// None.
    None,
    /// The first ones.
    Ordered,
    /// Any.
    Any,
}

impl Style {
    fn draw(stream: &mut Stream) -> Self {
        [Self::All, Self::None, Self::Ordered, Self::Any, Self::Any][stream.below(5) as usize]
    }

    fn changes(self, pending: &[Change], stream: &mut Stream) -> impl Iterator<Item = Change> {
        let prefix = stream.below(pending.len() as u32 + 1) as usize;
        let kept = |at: usize, stream: &mut Stream| match self {
            Self::All => true,
            Self::None => false,
            Self::Ordered => at < prefix,
            Self::Any => stream.below(2) == 0,
        };
        let kept: Vec<Change> =
            pending.iter().enumerate().filter(|(at, _)| kept(*at, stream)).map(|(_, change)| change.clone()).collect();
        kept.into_iter()
    }

    fn content(self, durable: &[u8], since: &[Vec<u8>], stream: &mut Stream) -> Vec<u8> {
        let Some(last) = since.last() else { return durable.to_vec() };
        let mut draw = |below: usize| stream.below(below.max(1) as u32) as usize;
        match self {
            Self::All => last.clone(),
            Self::None => durable.to_vec(),
            Self::Ordered => since[draw(since.len())].clone(),
            Self::Any => {
                let (old, new) = (durable, &since[draw(since.len())]);
                // What is the same in both is not written again.
                let same = old.iter().zip(new).take_while(|(a, b)| a == b).count();
                match draw(3) {
                    // Half a write.
                    0 => new[..same + draw(new.len() - same + 1)].to_vec(),
                    // The length is there, the rest of the data is not.
                    1 => {
                        let mut bytes = new.clone();
                        let from = same + draw(new.len() - same + 1);
                        bytes[from..].fill(0);
                        bytes
                    }
                    // Blocks of both.
                    _ => {
                        let mut bytes = new.clone();
                        for (at, block) in bytes.chunks_mut(BLOCK).enumerate().filter(|_| draw(2) == 0) {
                            let there = old.get(at * BLOCK..).unwrap_or_default();
                            let length = there.len().min(block.len());
                            block[..length].copy_from_slice(&there[..length]);
                            block[length..].fill(0);
                        }
                        bytes
                    }
                }
            }
        }
    }
}
