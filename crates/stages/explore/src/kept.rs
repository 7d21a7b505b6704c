//! The edits as they lie in the run's folder now. Several programs may have one run open: each sees what the others wrote, and
//! none loses it.

use crate::world::{Edited, World};
use artifacts::{Edit, Edits};
use gs_io::{Error, Lock, Result, Watched};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// How long a change waits for another program that is writing the file.
const PATIENCE: Duration = Duration::from_secs(10);

/// The edits of a run, in its folder and in memory.
pub struct Kept {
    /// The instances, by which it is seen that the run became another.
    run: Watched,
    /// As the file was when it was last looked at. Nobody holds the lock but to look and to write.
    now: Mutex<Arc<Edited>>,
}

/// Why there are no edits to answer with.
#[derive(Debug)]
pub enum Lost {
    /// The run is no more.
    Gone(Error),
    /// The run was clustered again, or the file is another's or damaged.
    Other(Error),
}

/// What became of a change.
pub enum Saved {
    /// It is in the file.
    Yes(Arc<Edited>),
    /// It is not: somebody changed the edits since, to these.
    Stale(Arc<Edited>),
}

impl Kept {
    /// The edits of a run that was just read; `run` was noted before.
    ///
    /// # Errors
    /// When the file is damaged or about other instances, or the run changed while it was read.
    pub fn new(world: &World, run: Watched) -> Result<Self> {
        let edited = world.saved(world.edits_file()?)?;
        run.check()?;
        Ok(Self { run, now: Mutex::new(Arc::new(edited)) })
    }

    /// The edits as they are now.
    ///
    /// # Errors
    /// When the run is not the one that was read, or the file is damaged or about other instances.
    pub fn now(&self, world: &World) -> Result<Arc<Edited>, Lost> {
        self.look(world, &mut self.now.lock().expect("no panic holds this lock"))
    }

    fn look(&self, world: &World, now: &mut Arc<Edited>) -> Result<Arc<Edited>, Lost> {
        let instances = &world.source.instances;
        if !instances.exists() {
            let e = Error::new("the run is no longer there").file(instances);
            return Err(Lost::Gone(e.hint("put it back, or end this program")));
        }
        let again = |_| Error::new("the run was clustered again since this program started").file(instances);
        self.run.check().map_err(|e| Lost::Other(again(e).hint("start explore again, and reload the page")))?;
        let file = world.edits_file().map_err(Lost::Other)?;
        if file.1 != now.version {
            *now = Arc::new(world.saved(file).map_err(Lost::Other)?);
        }
        Ok(Arc::clone(now))
    }

    /// Keeps these edits in place of those of the version `of`. Without a version they must begin with all that there are: so
    /// nothing is lost.
    ///
    /// # Errors
    /// As [`Self::now`]; inside, when an edit does not fit or the file cannot be written.
    pub fn replace(&self, world: &World, edits: Vec<Edit>, of: Option<&str>) -> Result<Result<Saved>, Lost> {
        let mut now = self.now.lock().expect("no panic holds this lock");
        // Its folder is made again by whoever takes the lock: looked for before, and again with the lock.
        self.look(world, &mut now)?;
        let path = world.source.edits();
        let lock = match Lock::wait(&path, PATIENCE) {
            Ok(lock) => lock,
            Err(e) => return Ok(Err(e)),
        };
        let there = self.look(world, &mut now)?;
        if !of.map_or(edits.starts_with(&there.edits.edits), |of| of == there.version) {
            return Ok(Ok(Saved::Stale(there)));
        }
        let kept = || {
            let edits = Edits { instances: world.scene.artifact.hash().into(), edits };
            let mut new = world.edited(edits, String::new())?;
            new.edits.write(&path)?;
            new.version = world.edits_file()?.1;
            Ok(Arc::new(new))
        };
        let kept = kept();
        drop(lock);
        Ok(kept.map(|new| {
            *now = Arc::clone(&new);
            Saved::Yes(new)
        }))
    }
}

impl From<Lost> for Error {
    fn from(lost: Lost) -> Self {
        match lost {
            Lost::Gone(e) | Lost::Other(e) => e,
        }
    }
}
