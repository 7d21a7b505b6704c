//! Which views training did not see: what a geometry's file says of it, and what a stage holds out.

use crate::dataset::{Dataset, HOLDOUT};
use crate::ply;
use gs_io::{Result, hash_bytes};
use std::path::Path;

/// What a PLY's comments say of the views that its Gaussians were learnt from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Learnt {
    /// Every n-th view was held out; 0: none.
    every: usize,
    /// [`Self::hash`] of the views.
    views: String,
}

impl Learnt {
    /// The name of a comment, and of a parameter of training: the hash of the views with their roles.
    pub const VIEWS: &'static str = "learnt_views";

    /// Hash of the names of all views of a dataset, each with whether it is held out where every n-th one is.
    pub fn hash(dataset: &Dataset, every: usize) -> String {
        let held = dataset.views.iter().zip(dataset.held_out(every));
        let lines: String = held.map(|(v, held)| format!("{held} {}\n", v.name)).collect();
        hash_bytes(lines.as_bytes())
    }

    /// What the file says; `None` where it says nothing, as a file from elsewhere.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn read(path: impl AsRef<Path>) -> Result<Option<Self>> {
        let comments = ply::comments(path.as_ref())?;
        let value = |name: &str| comments.iter().find_map(|c| c.strip_prefix(name)?.strip_prefix(' '));
        let every = value("holdout").and_then(|n| n.parse().ok());
        let views = value(Self::VIEWS).and_then(|h| h.strip_prefix('"')?.strip_suffix('"'));
        Ok(every.zip(views).map(|(every, views)| Self { every, views: views.into() }))
    }

    /// The comments that say so.
    pub fn comments(&self) -> [String; 2] {
        [format!("holdout {}", self.every), format!("{} \"{}\"", Self::VIEWS, self.views)]
    }

    /// Whether training did not see each of the dataset's views; `None` where they are not those that it knew.
    fn unseen(&self, dataset: &Dataset) -> Option<Vec<bool>> {
        (Self::hash(dataset, self.every) == self.views).then(|| dataset.held_out(self.every).collect())
    }
}

/// What a stage holds out: what it is told, else what training of its Gaussians held out, else every eighth view.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HoldOut {
    /// Every n-th view is held out; 0: none.
    pub every: usize,
    given: bool,
    learnt: Option<Learnt>,
}

impl HoldOut {
    /// For the Gaussians of a file; `given` is what an option says.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn of(geometry: impl AsRef<Path>, given: Option<usize>) -> Result<Self> {
        let learnt = Learnt::read(geometry)?;
        let every = given.or(learnt.as_ref().map(|l| l.every)).unwrap_or(HOLDOUT);
        Ok(Self { every, given: given.is_some(), learnt })
    }

    /// Whether training did not see each of the dataset's views; `None` where that is not known: the Gaussians are from
    /// elsewhere, or the dataset has other views than training had.
    pub fn unseen(&self, dataset: &Dataset) -> Option<Vec<bool>> {
        self.learnt.as_ref()?.unseen(dataset)
    }

    /// How many of the views held out training saw; `None` where that is not known.
    pub fn seen(&self, dataset: &Dataset) -> Option<usize> {
        let unseen = self.unseen(dataset)?;
        Some(dataset.held_out(self.every).zip(unseen).filter(|&(held, unseen)| held && !unseen).count())
    }

    /// What is to be said where an option holds out other views than training did.
    pub fn differs(&self, dataset: &Dataset) -> Option<String> {
        let learnt = self.learnt.as_ref()?;
        let unseen = self.unseen(dataset)?;
        if dataset.held_out(self.every).eq(unseen) {
            return None;
        }
        let those = match self.seen(dataset)? {
            0 => String::new(),
            seen => format!(": training saw {seen} of the views held out here"),
        };
        Some(format!("--holdout {}, but the Gaussians were trained with --holdout {}{those}", self.every, learnt.every))
    }

    /// Whether the views held out may be called so: an option says so, which is answered by [`Self::differs`] where it is wrong of
    /// these photographs' names, or training did not see them.
    pub fn is_trusted(&self, dataset: &Dataset) -> bool {
        self.given || self.seen(dataset) == Some(0)
    }
}
