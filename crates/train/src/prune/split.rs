//! Which views train, which are counted, and which judge (spec/pruning.md, Sec. 6.2).

use super::config::GuardViews;
use crate::error::{Error, Result};
use gazesplat_core::dataset::Holdout;
use gazesplat_core::{Dataset, View};

/// The views of a run.
#[derive(Debug, Clone)]
pub struct Split {
    /// Views of gradient steps.
    pub gradient: Vec<View>,
    /// Views that judge.
    pub guard: Vec<View>,
    /// All training views, the guard's included: what a Gaussian earns is counted in them.
    pub counted: Vec<View>,
    /// Which views judge, after all.
    pub views: GuardViews,
    /// Why these are not the ones that were asked for.
    pub note: Option<String>,
}

/// Fewer training views than this leave none to keep out.
const MIN_VIEWS_FOR_HOLDOUT: usize = 3;
/// One view in this many judges; the one in the middle of each group.
const GUARD_EVERY: usize = 8;

/// What is known about the views that a model was made from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Provenance {
    /// It was trained with this split.
    Trained(Holdout),
    /// The photographs are renders of the model itself: its quality on them says nothing about which it was trained on.
    OwnRenders,
    /// Nothing.
    Unknown,
}

/// Splits the training views of `dataset`, of which it must hold none out itself. A model that was trained on the views that
/// are to judge it has a quality on them that no retraining can hold, so these then stay in the gradient steps. Renders of
/// the model itself are held to floors, which can be held on unseen views as well.
///
/// # Errors
/// [`Error::NoTrainingViews`]; [`Error::Prune`] when the test views are to judge and there are none.
pub fn split(dataset: &Dataset, wanted: GuardViews, provenance: Provenance) -> Result<Split> {
    let counted = dataset.train.clone();
    if counted.is_empty() {
        return Err(Error::NoTrainingViews { num_test: dataset.test.len() });
    }
    if wanted == GuardViews::Test {
        if dataset.test.is_empty() {
            return Err(Error::Prune("the scene has no test views to judge the model by: set guard.views".to_owned()));
        }
        let (gradient, guard) = (counted.clone(), dataset.test.clone());
        return Ok(Split { gradient, guard, counted, views: wanted, note: None });
    }
    let judges = |index: usize| index % GUARD_EVERY == GUARD_EVERY / 2;
    let last = counted.len() - 1;
    let is_guard = |index: usize| if last < GUARD_EVERY { index == last.min(GUARD_EVERY / 2) } else { judges(index) };
    let of = |wanted: bool| -> Vec<View> {
        let views = counted.iter().enumerate().filter(|(index, _)| is_guard(*index) == wanted);
        views.map(|(_, view)| view.clone()).collect()
    };
    let guard = of(true);
    let note = (wanted == GuardViews::Holdout)
        .then(|| {
            if counted.len() < MIN_VIEWS_FOR_HOLDOUT {
                return Some(format!("{} training views are too few to keep one out", counted.len()));
            }
            match provenance {
                Provenance::Trained(Holdout::Every8) | Provenance::OwnRenders => None,
                Provenance::Trained(Holdout::None) => Some("the model was trained on all views".to_owned()),
                Provenance::Unknown => Some("it is not known which views the model was trained on".to_owned()),
            }
        })
        .flatten()
        .map(|why| format!("{why}: the views that judge it stay in the gradient steps"));
    let keeps_out = wanted == GuardViews::Holdout && note.is_none();
    let gradient = if keeps_out { of(false) } else { counted.clone() };
    let views = if keeps_out { GuardViews::Holdout } else { GuardViews::Train };
    Ok(Split { gradient, guard, counted, views, note })
}

#[cfg(test)]
mod tests {
    use super::*;
    use gazesplat_core::synthetic::{SynthOptions, write_scene};

    fn dataset(num_train: usize, num_test: usize) -> Dataset {
        let dir = tempfile::tempdir().expect("temporary directory");
        let options = SynthOptions { num_views: 3, width: 16, height: 16, num_points: 10, ..SynthOptions::default() };
        let scene = write_scene(dir.path(), &options).expect("writable");
        let views =
            |n: usize| (0..n).map(|i| View { name: format!("{i:02}"), ..scene.train[0].clone() }).collect::<Vec<_>>();
        Dataset { train: views(num_train), test: views(num_test), ..scene }
    }

    fn names(views: &[View]) -> Vec<&str> {
        views.iter().map(|v| v.name.as_str()).collect()
    }

    #[test]
    fn every_eighth_training_view_judges_and_stays_out() {
        let found = split(&dataset(21, 2), GuardViews::Holdout, Provenance::Trained(Holdout::Every8)).expect("views");
        assert_eq!(names(&found.guard), ["04", "12", "20"]);
        assert_eq!((found.gradient.len(), found.counted.len(), found.views), (18, 21, GuardViews::Holdout));
        assert!(!names(&found.gradient).contains(&"12") && found.note.is_none());
    }

    #[test]
    fn views_the_model_knows_stay_in_and_it_is_said() {
        for (provenance, why) in [
            (Provenance::Unknown, "it is not known which"),
            (Provenance::Trained(Holdout::None), "trained on all views"),
        ] {
            let found = split(&dataset(21, 2), GuardViews::Holdout, provenance).expect("views");
            assert_eq!((found.gradient.len(), found.guard.len(), found.views), (21, 3, GuardViews::Train));
            assert!(found.note.expect("said").contains(why));
        }
        let asked = split(&dataset(21, 2), GuardViews::Train, Provenance::Unknown).expect("views");
        assert!(asked.note.is_none() && asked.views == GuardViews::Train);
        let own = split(&dataset(21, 2), GuardViews::Holdout, Provenance::OwnRenders).expect("views");
        assert!(own.note.is_none() && own.views == GuardViews::Holdout && own.gradient.len() == 18);
    }

    #[test]
    fn few_views_have_one_judge_and_very_few_keep_it() {
        for (n, judge) in [(7, "04"), (4, "03"), (3, "02")] {
            let found =
                split(&dataset(n, 0), GuardViews::Holdout, Provenance::Trained(Holdout::Every8)).expect("views");
            assert_eq!((names(&found.guard), found.gradient.len()), (vec![judge], n - 1));
        }
        let found = split(&dataset(2, 0), GuardViews::Holdout, Provenance::Trained(Holdout::Every8)).expect("views");
        assert_eq!((found.gradient.len(), found.views), (2, GuardViews::Train));
        assert!(found.note.expect("said").contains("too few"));
        assert!(matches!(
            split(&dataset(0, 2), GuardViews::Train, Provenance::Unknown),
            Err(Error::NoTrainingViews { num_test: 2 })
        ));
    }

    #[test]
    fn test_views_judge_only_when_there_are_some() {
        let found = split(&dataset(9, 2), GuardViews::Test, Provenance::Unknown).expect("views");
        assert_eq!((found.guard.len(), found.gradient.len(), found.counted.len()), (2, 9, 9));
        assert!(split(&dataset(9, 0), GuardViews::Test, Provenance::Unknown).is_err());
    }
}
