"""The network of stations and targets: model, solver, datum, outliers, covariance."""
